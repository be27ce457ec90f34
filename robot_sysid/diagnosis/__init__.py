"""Looking at a log against the model before anything is estimated from it."""
