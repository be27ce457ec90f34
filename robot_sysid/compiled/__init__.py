"""The compiled model: what MuJoCo makes of a file, and whether a written one matches it."""
