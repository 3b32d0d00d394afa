"""Parameters of the people node: those of the filter node, for each person, and its own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from hmt_ros.sessions.declared_parameters import AT_ONCE, NEXT_CONFIGURE, parameter_field
from hmt_ros.sessions.filter_parameters import FilterParameters

# Inputs of a single person, whose topics can not tell which person it is.
_OF_ONE = {
    'subject_file': '',
    'use_predictions': False,
    'use_keypoints_3d': False,
    'person_id': '',
}


@dataclass(frozen=True)
class PeopleParameters(FilterParameters):
    """All parameters of the people node.

    Attributes:
        source: Type of the messages on the topic detections, 'people' (hmt_msgs/People2D), 'yolo'
            (yolo_msgs/DetectionArray), 'boxes' (vision_msgs/Detection2DArray) or 'floats'
            (std_msgs/Float32MultiArray).
        max_people: Maximum number of people who are followed at the same time; of those who come
            together the largest in the image are taken.
        use_keypoints: If true, keypoints of the detections are a measurement and start tracks; if
            false, only their boxes are used.
        frame_prefix: Prefix of the names of all frames on /tf and in human_description, before
            body_<id>/, which tells several robots apart.
    """

    source: str = parameter_field('people', NEXT_CONFIGURE)
    max_people: int = parameter_field(4, AT_ONCE, (1, 20))
    use_keypoints: bool = parameter_field(True, AT_ONCE)
    frame_prefix: str = parameter_field('', AT_ONCE)

    SOURCES: ClassVar[tuple[str, ...]] = ('people', 'yolo', 'boxes', 'floats')

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, unused in _OF_ONE.items():
            if getattr(self, name) != unused:
                raise ValueError(
                    f'{name} is {getattr(self, name)!r}, but people_node takes no input of one '
                    f'person: wanted {unused!r}, or filter_node'
                )
