"""The optimisation loop, the method of moving asymptotes, and the gradient check."""
