"""Numpy arrays to ROS messages and back, markers and URDF for viewers."""
