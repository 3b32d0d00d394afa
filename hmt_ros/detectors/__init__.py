"""Detectors of people in images that are not part of this package."""
