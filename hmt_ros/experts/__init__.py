"""Experts: pose mixtures predicted from one image, or from a window of keypoints (BME)."""

from hmt_ros.experts.calibrated_experts import CalibratedExperts
from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.experts.density_propagation import propagate
from hmt_ros.experts.expert_mixture import (
    ConditionalExperts,
    JointExperts,
)
from hmt_ros.experts.lifted_fit import KeypointPredictor, lift_poses
from hmt_ros.experts.lifter import Lifter, load_lifter
from hmt_ros.experts.neighbour_models import LocalExperts, NearestNeighbours
from hmt_ros.experts.network_experts import NetworkExperts
from hmt_ros.experts.pose_predictor import PosePredictor, load_predictor

__all__ = [
    'CalibratedExperts',
    'ConditionalDensity',
    'ConditionalExperts',
    'JointExperts',
    'KeypointPredictor',
    'Lifter',
    'LocalExperts',
    'NearestNeighbours',
    'NetworkExperts',
    'PosePredictor',
    'lift_poses',
    'load_lifter',
    'load_predictor',
    'propagate',
]
