"""Keypoint files of 2D detectors: their formats, the check of a clip, the choice of a person."""
