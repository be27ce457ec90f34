"""One end of a CAN bus, and talking to motors on it."""
