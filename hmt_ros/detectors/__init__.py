"""Detectors of people in images; their networks are not part of this package."""
