"""Estimating all links of an arm together."""
