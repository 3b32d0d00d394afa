"""The experts: poses predicted straight from an image, as a mixture (BME)."""

from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.experts.conditional_experts import ConditionalExperts
from hmt_ros.experts.density_propagation import propagate, propagate_by_dynamics
from hmt_ros.experts.joint_experts import JointExperts
from hmt_ros.experts.local_experts import LocalExperts
from hmt_ros.experts.nearest_neighbours import NearestNeighbours
from hmt_ros.experts.pose_predictor import PosePredictor
from hmt_ros.experts.relevance_vector_regression import RelevanceVectorRegression
from hmt_ros.experts.shipped_models import load_predictor

__all__ = [
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
