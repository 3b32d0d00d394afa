"""Files of 2D detectors: a module per family of formats, check of a clip, choice of a person."""
