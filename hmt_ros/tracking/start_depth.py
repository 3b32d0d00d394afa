"""The same names as `hmt_ros.image.joint_depths`, for modules that import them from here."""

from hmt_ros.image.joint_depths import depths_of

__all__ = ['depths_of']
