"""hmt_msgs/Ground: gravity, the floor, and the contacts of the feet."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from msg_tools.messages.headers import header_message, time_ns
from msg_tools.messages.message_error import Array, MessageError, check_finite, names_of, numbers
from msg_tools.messages.message_types import MessageFactory

GROUND = 'hmt_msgs/msg/Ground'


# Maximum error of the length of `up`, and of the entries of the plane.
_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class GroundState:
    """The content of an hmt_msgs/Ground.

    Attributes:
        stamp_ns, frame_id: stamp of the image, and optical frame of the camera.
        up: (3,) unit vector opposite to gravity.
        up_sigma: standard deviation of the direction of `up`, rad; NaN if unknown.
        height: height of the camera above the floor, m; None if unknown.
        height_sigma: standard deviation of the height, m; NaN if unknown.
        contacts: probability of floor contact by name of the foot, for example left_foot.

    Raises:
        MessageError: values are inconsistent or out of range.
    """

    stamp_ns: int
    frame_id: str
    up: Array
    up_sigma: float = math.nan
    height: float | None = None
    height_sigma: float = math.nan
    contacts: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        up = numbers(self.up, (3,), 'ground: up')
        check_finite(up, 'ground: up')
        if abs(float(np.linalg.norm(up, axis=0)) - 1.0) > _TOLERANCE:
            raise MessageError(f'ground: up is {up.tolist()}, wanted a vector of length 1')
        if self.height is not None and not math.isfinite(self.height):
            raise MessageError(f'ground: height is {self.height}, wanted a number, or NaN')
        for name, sigma in (('up_sigma', self.up_sigma), ('height_sigma', self.height_sigma)):
            if sigma < 0:
                raise MessageError(f'ground: {name} is {sigma}, wanted 0 or more, or NaN')
        for name, probability in self.contacts.items():
            if not 0 <= probability <= 1:
                raise MessageError(f'ground: contact of {name} is {probability}, wanted 0 to 1')
        up.flags.writeable = False
        object.__setattr__(self, 'up', up)

    @property
    def plane(self) -> Array | None:
        """The floor (4,): n, d with n.x + d = 0, n = up, d = height; None if unknown."""
        return None if self.height is None else np.array([*self.up, self.height])


def ground_message(messages: MessageFactory, content: GroundState) -> Any:
    """Makes an hmt_msgs/Ground."""
    x, y, z = content.up.tolist()
    plane = content.plane
    return messages.create(
        GROUND,
        header=header_message(messages, content.stamp_ns, content.frame_id),
        plane=np.full(4, math.nan) if plane is None else plane,
        up=messages.create('geometry_msgs/msg/Vector3', x=x, y=y, z=z),
        up_sigma=float(content.up_sigma),
        height=math.nan if content.height is None else float(content.height),
        height_sigma=float(content.height_sigma),
        contact_names=list(content.contacts),
        contact_probabilities=np.array(list(content.contacts.values()), dtype=np.float64),
    )


def ground_of(message: Any) -> GroundState:
    """Reads an hmt_msgs/Ground message of `rosbags` or of ROS.

    Raises:
        MessageError: values are inconsistent or out of range.
    """
    names = names_of(message.contact_names, 'ground: contacts')
    probabilities = numbers(
        message.contact_probabilities, (len(names),), 'ground: contact_probabilities'
    )
    height = float(message.height)
    content = GroundState(
        time_ns(message.header.stamp),
        str(message.header.frame_id),
        np.array([message.up.x, message.up.y, message.up.z]),
        float(message.up_sigma),
        None if math.isnan(height) else height,
        float(message.height_sigma),
        dict(zip(names, probabilities.tolist(), strict=True)),
    )
    plane = numbers(message.plane, (4,), 'ground: plane')
    wanted = np.full(4, math.nan) if content.plane is None else content.plane
    if not np.allclose(plane, wanted, rtol=0, atol=_TOLERANCE, equal_nan=True):
        raise MessageError(
            f'ground: plane is {plane.tolist()}, wanted {wanted.tolist()} of up and height'
        )
    return content
