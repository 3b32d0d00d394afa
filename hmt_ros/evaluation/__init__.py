"""Scores of mixtures and trajectories against ground truth."""
