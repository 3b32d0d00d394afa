"""Parameters of the node for REP 155."""

from __future__ import annotations

import re
from dataclasses import dataclass

from hmt_ros.sessions.declared_parameters import (
    AT_ONCE,
    NEXT_CONFIGURE,
    TRANSPORTS,
    NodeParameters,
    check_choices,
    parameter_field,
)

MIXTURES = ('pose_mixture', 'smoothed_pose_mixture')


@dataclass(frozen=True)
class HriParameters(NodeParameters):
    """All parameters of the node that speaks REP 155.

    Attributes:
        namespaces: Namespaces of the people whose mixtures are used, separated by blanks, such as
            '/humans/bodies/p1 /lab/anna'; if empty, all below /humans/bodies in which mixtures are
            published.
        mixture_topic: Topic of the mixtures in each person's namespace: 'pose_mixture' of the
            filter, or 'smoothed_pose_mixture' of the smoother, which is steadier but later.
        image_transport: Transport of the images: 'raw' (topic image) or 'compressed' (topic
            image/compressed).
        publish_cropped: If true, the node subscribes to images and publishes the part of each that
            shows a body.
        publish_links: If true, /tf has the frames of all links of a body; if false, only the frame
            of the body itself, for use with robot_state_publisher.
        added_joints: If true, the kinematic model has four joints more than the reference of REP
            155 and passes through all joint positions; if false, the trunk only leans, and the
            shoulders are fixed to it.
        queue_size: Maximum number of mixtures that wait; when the node is late, the oldest are
            dropped.
    """

    namespaces: str = parameter_field('', NEXT_CONFIGURE)
    mixture_topic: str = parameter_field('pose_mixture', NEXT_CONFIGURE)
    image_transport: str = parameter_field('raw', NEXT_CONFIGURE)
    publish_cropped: bool = parameter_field(True, NEXT_CONFIGURE)
    publish_links: bool = parameter_field(True, AT_ONCE)
    added_joints: bool = parameter_field(True, AT_ONCE)
    queue_size: int = parameter_field(5, AT_ONCE, (1, 1000))

    def __post_init__(self) -> None:
        check_choices(self, image_transport=TRANSPORTS, mixture_topic=MIXTURES)
        for namespace in self.named:
            if not re.fullmatch(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+', namespace):
                raise ValueError(
                    f'namespaces: wanted names such as /humans/bodies/anna, saw {namespace!r}'
                )

    @property
    def named(self) -> tuple[str, ...]:
        """The namespaces without duplicates."""
        return tuple(dict.fromkeys(self.namespaces.split()))
