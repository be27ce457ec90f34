"""Finding the motion: draws, gradients, rounds of improvement, and the processes that do them."""
