"""Detectors of people in images, whose networks are not part of this package."""
