"""The same names as `hmt_ros.image.silhouettes`, for modules that import them from here."""

from hmt_ros.image.silhouettes import Silhouettes, region_of

__all__ = ['Silhouettes', 'region_of']
