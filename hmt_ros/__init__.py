"""Monocular 3D human motion tracking with mixtures, as a library and as ROS 2 nodes."""

from pathlib import Path

from hmt_ros.compiled_code import keep_compiled_code_apart

__version__ = '1.0.0'

keep_compiled_code_apart(Path(__file__).parent)
