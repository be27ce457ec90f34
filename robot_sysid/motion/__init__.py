"""Designing a motion: trajectories, objective, limits, search."""
