"""A page and figures of what was found, for people who would rather look than read."""
