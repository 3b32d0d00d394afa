"""Motions: motion capture files, retargeting to our bodies, procedural motion, viewpoints."""
