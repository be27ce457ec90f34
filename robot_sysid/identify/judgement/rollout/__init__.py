"""Does the new model move more like the arm than the old one did?"""
