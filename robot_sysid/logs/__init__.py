"""Reading logs: which column is what, and what is wrong with them."""
