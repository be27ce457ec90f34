"""A simulated arm that plays the real one."""
