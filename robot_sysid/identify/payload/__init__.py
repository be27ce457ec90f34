"""A payload by difference: recordings without and with it, one estimate of all of them."""
