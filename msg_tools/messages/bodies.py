"""Makes hmt_msgs/Body, and finds the body of the poses in a message."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from hmt_ros.body import Body
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import MessageError, check_names
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.pose_mixtures import PoseMixture
from msg_tools.messages.trajectory_mixtures import TrajectoryMixture
from msg_tools.messages.urdf import body_urdf


def message_of_body(messages: MessageFactory, body: Body, stamp_ns: int, frame_id: str) -> Any:
    """Makes an hmt_msgs/Body from a body with its current segment lengths.

    Args:
        stamp_ns: stamp of the image from which the body was determined.
        frame_id: optical frame of the camera, which is also the root link of the URDF in the
            message.
    """
    return messages.create(
        'hmt_msgs/msg/Body',
        header=header_message(messages, stamp_ns, frame_id),
        name=body.name,
        dof_names=list(body.dof_names),
        lower=body.lower,
        upper=body.upper,
        joint_names=list(body.joint_names),
        segment_names=list(body.segment_lengths),
        segment_lengths=np.array(list(body.segment_lengths.values()), dtype=np.float64),
        urdf=body_urdf(body.skeleton, frame_id),
    )


def resized(model: Body, segment_lengths: Mapping[str, float]) -> Body:
    """A body model with the segment lengths of a message, m, or its own if the message has none.

    Raises:
        MessageError: a segment is unknown, or a length is not finite.
    """
    try:
        return model.with_segment_lengths(segment_lengths)
    except (KeyError, ValueError) as error:
        raise MessageError(f'body {model.name}: {error.args[0]}', 'body') from error


def body_of(
    content: PoseMixture | TrajectoryMixture, model: Body, *, any_name: bool = False
) -> Body:
    """The body of a mixture: the body model with the segment lengths in the message.

    Messages of other publishers may have no lengths; the model then keeps its own lengths.

    Args:
        any_name: whether to accept a message that names a different model.

    Raises:
        MessageError: the mixture has a different model or different degrees of freedom.
    """
    name = content.body_model
    if name not in ('', model.name) and not any_name:
        raise MessageError(f'mixture is of the body {name}, wanted one of {model.name}', 'body')
    check_names(content.dof_names, model.dof_names, 'mixture: dof_names')
    return resized(model, content.segment_lengths) if content.segment_lengths else model


def description_message(
    messages: MessageFactory, body: Body, frame_id: str, link_prefix: str = ''
) -> Any:
    """std_msgs/String with the URDF of a body, for viewers.

    The links are named like the frames of the transforms: the root link is `frame_id`, and all
    other names have the prefix.
    """
    return messages.create(
        'std_msgs/msg/String',
        data=body_urdf(body.skeleton, frame_id, link_prefix=link_prefix),
    )
