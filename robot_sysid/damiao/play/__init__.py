"""Playing a trajectory on motors: checked first, supervised, recorded."""
