"""The parts of the page, one module each: a run in, a section out."""
