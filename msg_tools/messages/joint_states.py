"""sensor_msgs/JointState, which moves the URDF of a body in a viewer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import MessageError
from msg_tools.messages.message_factory import MessageFactory
from msg_tools.messages.pose_mixtures import PoseMixture


def joint_state_message(
    messages: MessageFactory,
    dof_names: Sequence[str],
    pose: ArrayLike,
    stamp_ns: int,
    frame_id: str = '',
) -> Any:
    """sensor_msgs/JointState of a pose (d,): positions only, m or rad.

    Raises:
        MessageError: not one position for each name.
    """
    position = np.asarray(pose, dtype=np.float64)
    if position.shape != (len(dof_names),):
        raise MessageError(
            f'joint state has {len(dof_names)} names, but a pose of shape {position.shape}'
        )
    return messages.create(
        'sensor_msgs/msg/JointState',
        header=header_message(messages, stamp_ns, frame_id),
        name=list(dof_names),
        position=position,
        velocity=np.empty(0),
        effort=np.empty(0),
    )


def heaviest_joint_state(messages: MessageFactory, content: PoseMixture) -> Any:
    """sensor_msgs/JointState of the heaviest component of a mixture."""
    mixture = content.mixture
    return joint_state_message(
        messages,
        content.dof_names,
        mixture.means[int(np.argmax(mixture.weights))],
        content.stamp_ns,
        content.frame_id,
    )
