"""Silhouettes as vectors: contour, shape contexts, edge pairs (BME 3)."""
