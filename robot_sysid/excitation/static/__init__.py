"""Resting poses for arms that may not move fast: a payload's mass and centre of mass."""
