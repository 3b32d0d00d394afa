"""people_msgs/People and vision_msgs/Detection3DArray: people as points and as boxes.

The types are read from their packages where those are installed (`register_definitions`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.person_poses import PersonPose, person_pose, person_pose_message
from msg_tools.messages.pose_mixtures import PoseMixture

Array = NDArray[np.float64]

PEOPLE = 'people_msgs/msg/People'
DETECTIONS_3D = 'vision_msgs/msg/Detection3DArray'
PERSON = 'person'
# Flesh around the joints, m.
REACH = 0.12
# Components that have the pelvis this near to that of the heaviest say that the person is there, m.
THERE = 0.5


@dataclass(frozen=True, eq=False)
class SeenPerson:
    """One of several people, as its heaviest component shows it.

    Attributes:
        name: lasts as long as the track.
        pose: of the pelvis.
        velocity: (3,) of the pelvis, m/s; zeros: at rest, or unknown.
        probability: of all components that have the pelvis within 0.5 m of it.
        corners: (2, 3) least and greatest coordinates of the person, m.
    """

    name: str
    pose: PersonPose
    velocity: Array
    probability: float
    corners: Array

    @classmethod
    def of(cls, name: str, content: PoseMixture, body: Body) -> SeenPerson:
        """The person of a mixture.

        Args:
            name: of the person.
            content: with components and covariances.
            body: of the person.

        Raises:
            MessageError: no components, or no covariances.
        """
        best = int(np.argmax(content.weights))
        pose = person_pose(body, content.mixture)
        pelvis = body.joint_names.index('pelvis')
        joints = content.joint_positions
        away = np.linalg.norm(joints[:, pelvis] - joints[best, pelvis], axis=1)
        velocity = np.zeros(3)
        if content.joint_velocities is not None:
            velocity = content.joint_velocities[best, pelvis]
        corners = np.stack([joints[best].min(0) - REACH, joints[best].max(0) + REACH])
        return cls(name, pose, velocity, float(content.weights[away <= THERE].sum()), corners)


def people_message(
    messages: MessageFactory, people: Sequence[SeenPerson], stamp_ns: int, frame_id: str
) -> Any:
    """people_msgs/People; the reliability is the probability that the person is there."""
    return messages.create(
        PEOPLE,
        header=header_message(messages, stamp_ns, frame_id),
        people=[
            messages.create(
                'people_msgs/msg/Person',
                name=person.name,
                position=_point(messages, person.pose.position),
                velocity=_point(messages, person.velocity),
                reliability=person.probability,
                tagnames=[],
                tags=[],
            )
            for person in people
        ],
    )


def detections_message(
    messages: MessageFactory, people: Sequence[SeenPerson], stamp_ns: int, frame_id: str
) -> Any:
    """vision_msgs/Detection3DArray; boxes along the axes of the frame, with the pelvis for pose."""
    header = header_message(messages, stamp_ns, frame_id)

    def detection(person: SeenPerson) -> Any:
        hypothesis = messages.create(
            'vision_msgs/msg/ObjectHypothesis', class_id=PERSON, score=person.probability
        )
        x, y, z = (person.corners[1] - person.corners[0]).tolist()
        box = messages.create(
            'vision_msgs/msg/BoundingBox3D',
            center=messages.create(
                'geometry_msgs/msg/Pose',
                position=_point(messages, person.corners.mean(0)),
                orientation=messages.create(
                    'geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=0.0, w=1.0
                ),
            ),
            size=messages.create('geometry_msgs/msg/Vector3', x=x, y=y, z=z),
        )
        pose = person_pose_message(messages, person.pose, stamp_ns, frame_id).pose
        result = messages.create(
            'vision_msgs/msg/ObjectHypothesisWithPose', hypothesis=hypothesis, pose=pose
        )
        return messages.create(
            'vision_msgs/msg/Detection3D', header=header, results=[result], bbox=box, id=person.name
        )

    return messages.create(
        DETECTIONS_3D, header=header, detections=[detection(person) for person in people]
    )


def _point(messages: MessageFactory, values: Array) -> Any:
    x, y, z = values.tolist()
    return messages.create('geometry_msgs/msg/Point', x=x, y=y, z=z)
