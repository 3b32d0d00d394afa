"""The pose of a person: position, heading and their covariance.

geometry_msgs/PoseWithCovarianceStamped gives the direction that a person faces. The frame of a
person has its origin in the pelvis, x forward, y left, z towards the head (REP 103). The pose is
that of the heaviest component. The covariance is the second moment of the mixture about this pose:

    S = sum_k w_k (S_k + e_k e_k'),    e_k = (p_k - p_0, log R_k R_0')

It is large if the components disagree. Rotations are about the fixed axes of the frame of the
header, as the message defines them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from hmt_ros.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import root_rotation_dofs
from hmt_ros.body.rotations import rotation_vectors
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.linear_algebra import product
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import Array, MessageError, check_finite
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.states import pose_message, quaternions

PERSON_POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'

# Axes of the person frame as columns, in the frame of the pelvis (x right, y forward, z up).
_PERSON_IN_PELVIS = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class PersonPose(NamedTuple):
    """Pose of a person.

    Attributes:
        position: (3,) position of the pelvis, m.
        rotation: (3, 3) rotation from the frame of the person to the frame of the position.
        covariance: (6, 6) covariance of the position, m, and rotation about fixed axes, rad.
    """

    position: Array
    rotation: Array
    covariance: Array

    def seen_from(self, rotation: Array, translation: Array) -> PersonPose:
        """The pose in another frame, p' = R p + t with rotation (3, 3), translation (3,), m."""
        both = np.zeros((6, 6))
        both[:3, :3] = both[3:, 3:] = rotation
        return PersonPose(
            product(rotation, self.position) + translation,
            product(rotation, self.rotation),
            product(product(both, self.covariance), both.T),
        )


def person_pose(body: Body, mixture: GaussianMixture) -> PersonPose:
    """The pose of the person in a mixture over poses of a body.

    Raises:
        MessageError: a mixture without components.
    """
    if not len(mixture):
        raise MessageError('a mixture without components has no pose of a person')
    root = root_rotation_dofs(body.skeleton)
    frames = forward(body.skeleton, mixture.means)
    places = frames.origins[0].T
    turns = product(frames.columns[0].transpose(2, 1, 0), _PERSON_IN_PELVIS)
    # Jacobians of position and rotation of the root with respect to its degrees of freedom.
    jacobians = np.zeros((len(mixture), 6, body.dimension))
    jacobians[:, :3, :3] = frames.axes[:3].transpose(2, 1, 0)
    jacobians[:, 3:, root] = frames.axes[root].transpose(2, 1, 0)
    best = int(np.argmax(mixture.weights))
    away = rotation_vectors(product(turns, turns[best].T))
    errors = np.concatenate([places - places[best], away], axis=1)
    own = product(product(jacobians, mixture.covariances), jacobians.swapaxes(1, 2))
    weights = mixture.weights / mixture.weights.sum()
    covariance = np.einsum('k,kij->ij', weights, own + errors[:, :, None] * errors[:, None, :])
    return PersonPose(places[best], turns[best], 0.5 * (covariance + covariance.T))


def person_pose_message(
    messages: MessageFactory, pose: PersonPose, stamp_ns: int, frame_id: str
) -> Any:
    """Makes a geometry_msgs/PoseWithCovarianceStamped.

    Raises:
        MessageError: numbers that are not finite.
    """
    for values in pose:
        check_finite(values, 'person_pose')
    return messages.create(
        PERSON_POSE,
        header=header_message(messages, stamp_ns, frame_id),
        pose=messages.create(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=pose_message(messages, pose.position, quaternions(pose.rotation[None])[0]),
            covariance=pose.covariance.ravel(),
        ),
    )
