"""What passes between this computer and the motors in a run, and what is kept of it."""
