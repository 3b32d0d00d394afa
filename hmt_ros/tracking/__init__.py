"""The filter: proposals and mixture density propagation over images (KJS)."""

from hmt_ros.body.ground_terms import GroundSettings
from hmt_ros.image.subject import Subject, SubjectError, read_subject
from hmt_ros.tracking.existence import Status
from hmt_ros.tracking.ground import Ground, KnownGround
from hmt_ros.tracking.hypotheses import PosePrediction
from hmt_ros.tracking.lagged_weights import Lagged, LaggedWeights
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.tracker import Tracker

__all__ = [
    'Ground',
    'GroundSettings',
    'KnownGround',
    'Lagged',
    'LaggedWeights',
    'PosePrediction',
    'Status',
    'Subject',
    'SubjectError',
    'Tracker',
    'TrackerSettings',
    'read_subject',
]
