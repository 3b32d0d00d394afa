"""hmt_msgs/Body: what the numbers of all other messages mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body import Body
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import MessageError
from msg_tools.messages.message_factory import MessageFactory
from msg_tools.messages.urdf import body_urdf, segments_of


def body_message(
    messages: MessageFactory,
    *,
    name: str,
    dof_names: Sequence[str],
    lower: ArrayLike,
    upper: ArrayLike,
    joint_names: Sequence[str],
    segment_lengths: Mapping[str, float],
    urdf: str,
    stamp_ns: int,
    frame_id: str,
) -> Any:
    """hmt_msgs/Body.

    Args:
        messages: factory of messages.
        name: of the body model.
        dof_names: (d,) degrees of freedom.
        lower, upper: (d,) limits, m or rad.
        joint_names: (J,) joints.
        segment_lengths: m, by the name of the length, in this order.
        urdf: the same body for viewers, see `msg_tools.messages.urdf`.
        stamp_ns: of the image that fixed the body.
        frame_id: optical frame of the camera.

    Raises:
        MessageError: limits that are not one for each degree of freedom.
    """
    limits = [np.asarray(limit, dtype=np.float64) for limit in (lower, upper)]
    if any(limit.shape != (len(dof_names),) for limit in limits):
        raise MessageError(
            f'body has {len(dof_names)} dof_names, but limits of shapes {limits[0].shape} and '
            f'{limits[1].shape}'
        )
    return messages.create(
        'hmt_msgs/msg/Body',
        header=header_message(messages, stamp_ns, frame_id),
        name=name,
        dof_names=list(dof_names),
        lower=limits[0],
        upper=limits[1],
        joint_names=list(joint_names),
        segment_names=list(segment_lengths),
        segment_lengths=np.array(list(segment_lengths.values()), dtype=np.float64),
        urdf=urdf,
    )


def message_of_body(messages: MessageFactory, body: Body, stamp_ns: int, frame_id: str) -> Any:
    """hmt_msgs/Body of a body at its present lengths; the root of its URDF is `frame_id`."""
    return body_message(
        messages,
        name=body.name,
        dof_names=body.dof_names,
        lower=body.lower,
        upper=body.upper,
        joint_names=body.joint_names,
        segment_lengths=body.segment_lengths,
        urdf=body_urdf(body.name, segments_of(body.skeleton), frame_id),
        stamp_ns=stamp_ns,
        frame_id=frame_id,
    )


def description_message(
    messages: MessageFactory, body: Body, frame_id: str, link_prefix: str = ''
) -> Any:
    """std_msgs/String with the URDF of a body, as viewers want it.

    Its links are the frames of the transforms: the root is `frame_id`, all others have the prefix.
    """
    return messages.create(
        'std_msgs/msg/String',
        data=body_urdf(body.name, segments_of(body.skeleton), frame_id, link_prefix=link_prefix),
    )
