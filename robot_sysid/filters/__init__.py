"""Filters for measured signals."""
