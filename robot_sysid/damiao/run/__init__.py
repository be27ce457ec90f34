"""A whole run: what is checked before, the plan, and who is called in which order."""
