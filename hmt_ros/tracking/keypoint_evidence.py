"""The same names as `hmt_ros.image.keypoint_evidence`, for modules that import them from here."""

from hmt_ros.image.keypoint_evidence import keypoint_evidence, suffices

__all__ = ['keypoint_evidence', 'suffices']
