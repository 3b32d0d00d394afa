"""Measurements, each next to a yardstick of the same run: `python -m benchmarks --help`."""
