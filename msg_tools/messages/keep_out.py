"""hmt_msgs/KeepOut: capsules around the person, for planners and viewers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from msg_tools.messages.headers import header_message, time_ns
from msg_tools.messages.message_error import (
    Array,
    MessageError,
    check_finite,
    constant_of,
    freeze_arrays,
    numbers,
)
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.states import pose_message

KEEP_OUT = 'hmt_msgs/msg/KeepOut'


_ADD, _DELETE_ALL = 0, 3
_SPHERE, _CYLINDER = 2, 3
_COLOUR = {'r': 0.85, 'g': 0.15, 'b': 0.10, 'a': 0.25}
# Constants of shape_msgs/SolidPrimitive.
_SOLID_SPHERE, _SOLID_CYLINDER = 2, 3
# Length of an axis below which a capsule is a sphere, m.
_MIN_AXIS_LENGTH = 1e-6


class KeepOutState(IntEnum):
    """State of the person; values as in KeepOut.msg."""

    UNKNOWN = 0
    TRACKING = 1
    LOST = 2
    NOBODY = 3
    STALE = 4


@dataclass(frozen=True, eq=False)
class KeepOut:
    """The content of an hmt_msgs/KeepOut.

    Attributes:
        stamp_ns, frame_id: time of the state, and frame of the capsules.
        state: state of the person.
        starts, ends: (N, 3) end points of the axes of the capsules, m.
        radii: (N,) radii of the capsules, m.
        track_id: number of the track; 0 if missing.
        existence_probability: probability that a person is in view; NaN if unknown.
        unseen: time since the last image that showed the person, s; NaN if no image did.
        probability: requested probability that the capsules contain the person, see KeepOut.msg.
        reason: reason why the state is unknown; '' if it is known.

    Raises:
        MessageError: values are inconsistent or out of range.
    """

    stamp_ns: int
    frame_id: str
    state: KeepOutState
    starts: Array
    ends: Array
    radii: Array
    track_id: int = 0
    existence_probability: float = math.nan
    unseen: float = math.nan
    probability: float = math.nan
    reason: str = ''

    def __post_init__(self) -> None:
        n = len(self.radii)
        shapes = {'starts': (n, 3), 'ends': (n, 3), 'radii': (n,)}
        freeze_arrays(self, shapes, 'keep out')
        for name in shapes:
            check_finite(getattr(self, name), f'keep out: {name}')
        if n and self.radii.min() < 0:
            raise MessageError(f'keep out: a radius is {self.radii.min()}, wanted 0 or more')
        if n and self.state is KeepOutState.NOBODY:
            raise MessageError(f'keep out: {n} capsules of nobody, wanted none')
        if self.unseen < 0:
            raise MessageError(f'keep out: unseen is {self.unseen} s, wanted 0 or more, or NaN')


def keep_out_message(messages: MessageFactory, content: KeepOut) -> Any:
    """Makes an hmt_msgs/KeepOut."""
    return messages.create(
        KEEP_OUT,
        header=header_message(messages, content.stamp_ns, content.frame_id),
        state=int(content.state),
        track_id=content.track_id,
        existence_probability=float(content.existence_probability),
        unseen=float(content.unseen),
        probability=float(content.probability),
        starts=content.starts.ravel(),
        ends=content.ends.ravel(),
        radii=np.array(content.radii),
        reason=content.reason,
    )


def keep_out_of(message: Any) -> KeepOut:
    """Reads an hmt_msgs/KeepOut message of `rosbags` or of ROS.

    Raises:
        MessageError: values are inconsistent or out of range.
    """
    n = len(message.radii)
    flat = {
        name: numbers(getattr(message, name), (3 * n,), f'keep out: {name}')
        for name in ('starts', 'ends')
    }
    return KeepOut(
        time_ns(message.header.stamp),
        str(message.header.frame_id),
        constant_of(KeepOutState, message.state, f'keep out: state {message.state} is unknown'),
        flat['starts'].reshape(n, 3),
        flat['ends'].reshape(n, 3),
        np.asarray(message.radii, dtype=np.float64),
        int(message.track_id),
        float(message.existence_probability),
        float(message.unseen),
        float(message.probability),
        str(message.reason),
    )


def collision_shapes(messages: MessageFactory, content: KeepOut) -> tuple[list[Any], list[Any]]:
    """Converts each capsule to a cylinder and two spheres, for planners without capsules.

    Returns:
        shape_msgs/SolidPrimitive and geometry_msgs/Pose of each part, for a
        moveit_msgs/CollisionObject.
    """
    solids, poses = [], []
    for kind, size, place, turn in _pieces(content):
        dimensions = np.array([size[1], size[0]] if kind == _CYLINDER else [size[0]])
        solid = _SOLID_CYLINDER if kind == _CYLINDER else _SOLID_SPHERE
        solids.append(
            messages.create('shape_msgs/msg/SolidPrimitive', type=solid, dimensions=dimensions)
        )
        poses.append(pose_message(messages, place, turn))
    return solids, poses


def keep_out_markers(messages: MessageFactory, content: KeepOut) -> Any:
    """visualization_msgs/MarkerArray of the capsules, which also deletes earlier markers."""
    header = header_message(messages, content.stamp_ns, content.frame_id)
    name = 'visualization_msgs/msg/Marker'
    markers = [messages.create(name, header=header, action=_DELETE_ALL)]
    colour = messages.create('std_msgs/msg/ColorRGBA', **_COLOUR)
    for number, (kind, size, place, turn) in enumerate(_pieces(content)):
        width = 2.0 * size[0]
        scale = {'x': width, 'y': width, 'z': size[1] if kind == _CYLINDER else width}
        markers.append(
            messages.create(
                name,
                header=header,
                ns='keep_out',
                id=number,
                type=kind,
                action=_ADD,
                pose=pose_message(messages, place, turn),
                scale=messages.create('geometry_msgs/msg/Vector3', **scale),
                color=colour,
            )
        )
    return messages.create('visualization_msgs/msg/MarkerArray', markers=markers)


def _pieces(content: KeepOut) -> list[tuple[int, tuple[float, float], Array, Array]]:
    """Kind, (radius, length), centre (3,) and rotation from z (4,) of each sphere and cylinder."""
    result: list[tuple[int, tuple[float, float], Array, Array]] = []
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    for start, end, radius in zip(content.starts, content.ends, content.radii, strict=True):
        axis = end - start
        length = float(np.linalg.norm(axis, axis=0))
        result.append((_SPHERE, (float(radius), 0.0), start, upright))
        if length < _MIN_AXIS_LENGTH:
            continue
        result.append((_SPHERE, (float(radius), 0.0), end, upright))
        turn = _turn_to(axis / length)
        result.append((_CYLINDER, (float(radius), length), 0.5 * (start + end), turn))
    return result


def _turn_to(axis: Array) -> Array:
    """Quaternion (4,) x, y, z, w that rotates z to a unit vector (3,)."""
    x, y, z = axis.tolist()
    turn = np.array([-y, x, 0.0, 1.0 + z]) if z > -0.999999 else np.array([1.0, 0.0, 0.0, 0.0])
    return np.asarray(turn / np.linalg.norm(turn, axis=0))
