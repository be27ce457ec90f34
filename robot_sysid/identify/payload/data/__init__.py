"""Recordings with and without a payload, from the log to the rows that are fitted."""
