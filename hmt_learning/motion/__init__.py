"""Motion files, retargeting to the body models, and procedural motion."""
