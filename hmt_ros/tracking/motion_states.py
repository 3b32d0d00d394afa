"""The same names as `hmt_ros.inference.motion_states`, for modules that import them from here."""

from hmt_ros.inference.motion_states import PredictedStates

__all__ = ['PredictedStates']
