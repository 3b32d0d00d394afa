"""Motion files, retargeting to our bodies, and procedural motion."""
