"""Files of 2D detectors: one file per family of formats, the check of a clip, and who is chosen."""
