"""The forms that recordings come in, each read into titled columns of numbers."""
