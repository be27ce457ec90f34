"""Identifications by where the torques come from, and the fit they share."""
