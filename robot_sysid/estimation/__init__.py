"""The one estimate: what is sought, the rows that data makes of it, the fit, and its judge."""
