"""Simulated motors and the arm they drive, to rehearse without hardware."""
