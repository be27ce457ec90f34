"""The parts of excitation design: trajectories, objective, constraints, search."""
