"""Mixtures over trajectories, from a filter's chain of modes or from independent mixtures (VMS)."""

from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.mode_chain import Link, backward_weights, drawn_paths
from hmt_ros.smoothing.mixture_smoother import MixtureSmoother
from hmt_ros.smoothing.motion_smoother import ImageModes, MotionSmoother
from hmt_ros.smoothing.sliding_window import FinalPose, SlidingWindow, WindowUpdate
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture

__all__ = [
    'FinalPose',
    'ImageModes',
    'LinearGaussianDynamics',
    'Link',
    'MixtureSmoother',
    'MotionSmoother',
    'SlidingWindow',
    'TrajectoryMixture',
    'WindowUpdate',
    'backward_weights',
    'drawn_paths',
]
