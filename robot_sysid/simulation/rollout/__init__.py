"""Models that are played: many rollouts at a time, in MuJoCo."""
