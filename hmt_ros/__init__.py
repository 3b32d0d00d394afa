"""Monocular 3D human motion tracking with mixtures, as a library and as ROS 2 nodes."""

__version__ = '0.1.0'
