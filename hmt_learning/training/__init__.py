"""Training sets, and the learning of priors, of motion, and of experts."""
