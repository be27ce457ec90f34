"""What is printed of a result: tables before -> after, and the blocks they stand in."""
