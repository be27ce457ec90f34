"""The one estimate: unknowns, linearised rows of recordings, their fit, its errors and tests."""
