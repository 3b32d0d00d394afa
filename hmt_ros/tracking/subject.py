"""The same names as `hmt_ros.image.subject`, for modules that import them from here."""

from hmt_ros.image.subject import Subject

__all__ = ['Subject']
