"""The same names as `hmt_ros.image.person_shape`, for modules that import them from here."""

from hmt_ros.image.person_shape import raster_step

__all__ = ['raster_step']
