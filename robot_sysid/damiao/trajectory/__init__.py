"""The trajectory file that motors play, and what had to be clamped in it."""
