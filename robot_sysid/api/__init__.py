"""The face for Python programs: what the commands do, with arrays in and results out.

Nothing is printed, and no file is written unless a result is asked to ``save``.
"""
