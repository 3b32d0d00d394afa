"""Experts: pose mixtures predicted from one image (BME)."""

from hmt_ros.experts.calibrated_experts import CalibratedExperts
from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.experts.density_propagation import propagate, propagate_by_dynamics
from hmt_ros.experts.expert_mixture import (
    ConditionalExperts,
    JointExperts,
    RelevanceVectorRegression,
)
from hmt_ros.experts.neighbour_models import LocalExperts, NearestNeighbours
from hmt_ros.experts.pose_predictor import PosePredictor, load_predictor

__all__ = [
    'CalibratedExperts',
    'ConditionalDensity',
    'ConditionalExperts',
    'JointExperts',
    'LocalExperts',
    'NearestNeighbours',
    'PosePredictor',
    'RelevanceVectorRegression',
    'load_predictor',
    'propagate',
    'propagate_by_dynamics',
]
