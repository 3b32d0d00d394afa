"""Mixtures over whole trajectories: network, paths, refinement, variational mixture (VMS)."""

from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.smoothing.mixture_smoother import MixtureSmoother
from hmt_ros.smoothing.sliding_window import FinalPose, SlidingWindow, WindowUpdate
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture

__all__ = [
    'FinalPose',
    'LinearGaussianDynamics',
    'MixtureSmoother',
    'SlidingWindow',
    'TrajectoryMixture',
    'WindowUpdate',
]
