"""Converts numpy arrays to ROS messages and back, and makes markers and URDF for viewers."""
