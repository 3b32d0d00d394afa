"""Parameters of the BME node and of its offline replay."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_ros.experts.lifter import SHIPPED as LIFTER
from hmt_ros.experts.pose_predictor import PROPAGATIONS, WITHOUT_PROPAGATION
from hmt_ros.sessions.camera_frames import unit_vector
from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    NEXT_CONFIGURE,
    CameraNodeParameters,
    check_choices,
    parameter_field,
)

# Cues from which predictions are made.
FROM_SILHOUETTES, FROM_KEYPOINTS, FROM_BOTH = 'silhouettes', 'keypoints', 'both'
CUES = (FROM_SILHOUETTES, FROM_KEYPOINTS, FROM_BOTH)


@dataclass(frozen=True)
class BmeParameters(CameraNodeParameters):
    """All parameters of the BME node.

    Attributes:
        model_file: Model file written by `train`; if empty, the small model shipped with the
            package.
        background_file: Image from the same camera without people; if empty, the background is
            learned once nothing has moved for two seconds.
        stature: Height of the person, m; 0 selects the height of the model's body.
        gravity: Direction of gravity in the camera optical frame, three numbers of any scale, by
            which images and keypoints of a camera on its side are turned upright; if empty, the
            camera is upright.
        predict_from: Cue of the predictions: 'silhouettes', 'keypoints' of a detector (no image is
            needed), or 'both'. With 'both' an image waits for its keypoints, and silhouettes are
            used if these show nobody.
        lifter: Experts that predict poses from keypoints: 'keypoints' (shipped) or a file written
            by 'learn lifter'.
        propagation: Dependence of a prediction on the previous one: 'none', or 'experts', rule (1)
            of the paper, which needs a model trained with --dynamics.
        max_hypotheses: Maximum number of components of a prediction.
        tracked_interval: Interval between predictions while pose_mixture says that the filter
            tracks the person, s, by image stamps; 0 predicts from every image.
    """

    model_file: str = parameter_field('', NEXT_CONFIGURE)
    background_file: str = parameter_field('', NEXT_CONFIGURE)
    stature: float = parameter_field(0.0, NEXT_CONFIGURE, (0.0, 3.0))
    gravity: tuple[float, ...] = parameter_field((), NEXT_CONFIGURE)
    predict_from: str = parameter_field(FROM_SILHOUETTES, NEXT_CONFIGURE)
    lifter: str = parameter_field(LIFTER, NEXT_CONFIGURE)
    propagation: str = parameter_field(WITHOUT_PROPAGATION, NEXT_CONFIGURE)
    max_hypotheses: int = parameter_field(5, AT_ONCE, (1, 64))
    tracked_interval: float = parameter_field(0.0, NEXT_CONFIGURE, (0.0, 3600.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gravity:
            unit_vector(self.gravity, 'gravity')
        check_choices(self, propagation=PROPAGATIONS, predict_from=CUES)
        if self.predict_from != FROM_SILHOUETTES and not self.lifter:
            raise ValueError(f"predict_from {self.predict_from!r} needs a lifter, saw ''")
