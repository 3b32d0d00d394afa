"""Parameters of the keypoints adapter node.

`hmt_ros/config/keypoints_adapter_node.yaml` lists them with their defaults; it is written by

    python -m hmt_ros.sessions.keypoints_adapter_parameters > \
        hmt_ros/config/keypoints_adapter_node.yaml
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    NEXT_CONFIGURE,
    NodeParameters,
    parameter_field,
)
from hmt_ros.sessions.parameter_file import parameter_file_text
from msg_tools.messages.detections import FLOATS, SKELETON_2D, YOLO

# Types of the messages by value of the parameter `source`.
SOURCES = {'skeleton2d': SKELETON_2D, 'yolo': YOLO, 'floats': FLOATS}


@dataclass(frozen=True)
class KeypointsAdapterParameters(NodeParameters):
    """All parameters of the keypoints adapter node.

    Attributes:
        source: Type of the messages on the topic detections, 'skeleton2d' (hri_msgs/Skeleton2D),
            'yolo' (yolo_msgs/DetectionArray) or 'floats' (std_msgs/Float32MultiArray).
        scheme: Scheme whose order the keypoints of 'yolo' and 'floats' follow: 'coco17', 'halpe26',
            'body25', 'mediapipe33', 'h36m17', 'skeleton2d', 'smpl24' or 'mhr70'.
        person_id: Identity that the detector gives the person who is tracked; if empty, it is the
            largest person at first, and then the one nearest to where this person was last.
        longest_absence: Time without the person after which the largest one is chosen anew, by the
            stamps of the detections, s.
    """

    source: str = parameter_field('skeleton2d', NEXT_CONFIGURE)
    scheme: str = parameter_field('coco17', NEXT_CONFIGURE)
    person_id: str = parameter_field('', AT_ONCE)
    longest_absence: float = parameter_field(1.0, AT_ONCE, (0.0, 3600.0))

    def __post_init__(self) -> None:
        if self.source not in SOURCES:
            raise ValueError(f'source must be one of {tuple(SOURCES)}, saw {self.source!r}')
        if self.scheme not in schemes():
            raise ValueError(f'scheme must be one of {tuple(schemes())}, saw {self.scheme!r}')


if __name__ == '__main__':
    sys.stdout.write(parameter_file_text('keypoints_adapter_node', KeypointsAdapterParameters()))
