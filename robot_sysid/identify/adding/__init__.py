"""Putting logs together: with those of an earlier run, and as records that add."""
