"""Files about a whole arm: its links and joints, and its friction for controllers."""
