"""Parameters of the keypoints node.

`hmt_ros/config/keypoints_node.yaml` lists them with their defaults; it is written by

    python -m hmt_ros.sessions.keypoints_parameters > hmt_ros/config/keypoints_node.yaml
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

from hmt_ros.detectors.registry import DETECTORS, USUAL_DETECTOR
from hmt_ros.sessions.declared_parameters import (
    NEXT_CONFIGURE,
    ImageNodeParameters,
    check_choices,
    parameter_field,
)
from hmt_ros.sessions.parameter_file import parameter_file_text


@dataclass(frozen=True)
class KeypointsParameters(ImageNodeParameters):
    """All parameters of the keypoints node.

    Attributes:
        detector: Detector of keypoints; 'mediapipe' is MediaPipe Pose.
        publish_mask: If true, the node also publishes the mask of the person.
    """

    detector: str = parameter_field(USUAL_DETECTOR, NEXT_CONFIGURE)
    publish_mask: bool = parameter_field(False, NEXT_CONFIGURE)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choices(self, detector=tuple(DETECTORS))


if __name__ == '__main__':
    sys.stdout.write(parameter_file_text('keypoints_node', KeypointsParameters()))
