"""Poses for viewers and robots, as sensor_msgs/JointState and tf2_msgs/TFMessage.

Joint states have the joint names of the URDF.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import Array, MessageError
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.pose_mixtures import PoseMixture


def joint_state_message(
    messages: MessageFactory,
    dof_names: Sequence[str],
    pose: ArrayLike,
    stamp_ns: int,
    frame_id: str = '',
) -> Any:
    """sensor_msgs/JointState of a pose (d,) with positions only, m or rad.

    Raises:
        MessageError: positions and names differ in number.
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
    """sensor_msgs/JointState of the heaviest component of a non-empty mixture."""
    return joint_state_message(
        messages,
        content.dof_names,
        content.means[int(np.argmax(content.weights))],
        content.stamp_ns,
        content.frame_id,
    )


def quaternions(rotations: ArrayLike) -> Array:
    """Unit quaternions (N, 4), x y z w with w >= 0, of rotation matrices (N, 3, 3)."""
    r = np.asarray(rotations, dtype=np.float64)
    xx, yy, zz = np.diagonal(r, axis1=1, axis2=2).T
    # 4 q q^T for q = (x, y, z, w) is linear in R; its longest row gives q with full accuracy.
    outer = np.empty((len(r), 4, 4))
    outer[:, :3, :3] = r + r.swapaxes(1, 2)
    outer[:, 3, :3] = outer[:, :3, 3] = (r - r.swapaxes(1, 2))[:, (2, 0, 1), (1, 2, 0)]
    squares = 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz
    outer[:, range(4), range(4)] = np.stack(squares, axis=1)
    longest = np.argmax(np.diagonal(outer, axis1=1, axis2=2), axis=1)
    q = outer[np.arange(len(r)), longest]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    result: Array = np.where(q[:, 3:] < 0, -q, q)
    return result


def pose_message(messages: MessageFactory, place: ArrayLike, turn: ArrayLike) -> Any:
    """geometry_msgs/Pose of a position (3,), m, and a quaternion (4,) x, y, z, w."""
    px, py, pz = np.asarray(place, dtype=np.float64).tolist()
    x, y, z, w = np.asarray(turn, dtype=np.float64).tolist()
    return messages.create(
        'geometry_msgs/msg/Pose',
        position=messages.create('geometry_msgs/msg/Point', x=px, y=py, z=pz),
        orientation=messages.create('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
    )


def transforms_message(
    messages: MessageFactory,
    parents: Sequence[str],
    children: Sequence[str],
    rotations: ArrayLike,
    translations: ArrayLike,
    stamp_ns: int,
) -> Any:
    """Makes a tf2_msgs/TFMessage.

    Args:
        parents, children: (N,) names of frames.
        rotations: (N, 3, 3) R in p_parent = R p_child + t.
        translations: (N, 3) t, m.

    Raises:
        MessageError: inconsistent lengths of arrays, or values that are not finite.
    """
    r = np.asarray(rotations, dtype=np.float64)
    t = np.asarray(translations, dtype=np.float64)
    n = len(children)
    if len(parents) != n or r.shape != (n, 3, 3) or t.shape != (n, 3):
        raise MessageError(
            f'transforms: {len(parents)} parents, {n} children, rotations {r.shape} and '
            f'translations {t.shape} do not fit'
        )
    if not (np.isfinite(r).all() and np.isfinite(t).all()):
        raise MessageError('transforms: a rotation or translation is not finite')
    transforms = [
        messages.create(
            'geometry_msgs/msg/TransformStamped',
            header=header_message(messages, stamp_ns, parent),
            child_frame_id=child,
            transform=messages.create(
                'geometry_msgs/msg/Transform',
                translation=messages.create('geometry_msgs/msg/Vector3', x=x, y=y, z=z),
                rotation=messages.create('geometry_msgs/msg/Quaternion', x=qx, y=qy, z=qz, w=qw),
            ),
        )
        for parent, child, (x, y, z), (qx, qy, qz, qw) in zip(
            parents, children, t.tolist(), quaternions(r).tolist(), strict=True
        )
    ]
    return messages.create('tf2_msgs/msg/TFMessage', transforms=transforms)
