"""The terms of the image likelihood, one file each, and the compiled pass that runs them."""
