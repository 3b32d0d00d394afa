"""Training sets, and the learning of priors, motion and experts."""
