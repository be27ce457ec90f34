"""Estimators: one module per family; ``registry`` finds them by name."""
