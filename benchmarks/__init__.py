"""Measurements, each next to a peer's or a yardstick in the same run: `python -m benchmarks --help`."""
