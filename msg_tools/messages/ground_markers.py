"""visualization_msgs/Marker: the floor under the person, and the feet that stand on it.

The floor is a translucent square in the namespace `floor`, the feet are spheres in the namespace
`contacts`, the less probable the fainter. What is not known any more is deleted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msg_tools.messages.ground import GroundState
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.states import quaternions

FLOOR, CONTACTS = 'floor', 'contacts'

Array = NDArray[np.float64]

_ADD, _DELETE = 0, 2
_CUBE, _SPHERE_LIST = 1, 7
# Side and thickness of the square, m; its top is the floor.
_SIDE, _THICK = 3.0, 0.005
_FLOOR_COLOUR = (0.55, 0.55, 0.50, 0.30)
_CONTACT_COLOUR = (0.00, 0.62, 0.45)
_SPHERE = 0.09  # diameter, m
# A foot that stands with a lower probability is not shown.
_LEAST = 0.05
# Joints of a foot, by the end of its name.
_JOINTS = ('ankle', 'toe')


def ground_markers(
    messages: MessageFactory,
    content: GroundState,
    joint_positions: ArrayLike,
    joint_names: Sequence[str],
) -> list[Any]:
    """visualization_msgs/Marker of the floor and of the contacts of one pose.

    Args:
        messages: factory of messages.
        content: gravity, the floor, contacts.
        joint_positions: (J, 3) m, in the frame of the content; the floor is drawn under their
            middle.
        joint_names: (J,); feet without joints of their side are left out.
    """
    positions = np.asarray(joint_positions, dtype=np.float64)
    header = header_message(messages, content.stamp_ns, content.frame_id)
    plane = content.plane
    floor = _deleted(messages, header, FLOOR)
    if plane is not None:
        floor = _floor(messages, header, plane, positions.mean(0))
    contacts = _deleted(messages, header, CONTACTS)
    points, shares = _standing(content, positions, joint_names)
    if points:
        size = messages.create('geometry_msgs/msg/Vector3', x=_SPHERE, y=_SPHERE, z=_SPHERE)
        contacts = messages.create(
            'visualization_msgs/msg/Marker',
            header=header,
            ns=CONTACTS,
            type=_SPHERE_LIST,
            action=_ADD,
            pose=messages.create('geometry_msgs/msg/Pose'),
            scale=size,
            color=_colour(messages, *_CONTACT_COLOUR, 1.0),
            points=messages.points(np.array(points)),
            colors=[_colour(messages, *_CONTACT_COLOUR, share) for share in shares],
        )
    return [floor, contacts]


def removed_ground(messages: MessageFactory, stamp_ns: int, frame_id: str) -> list[Any]:
    """visualization_msgs/Marker that delete those of `ground_markers`."""
    header = header_message(messages, stamp_ns, frame_id)
    return [_deleted(messages, header, name) for name in (FLOOR, CONTACTS)]


def _standing(
    content: GroundState, positions: Array, joint_names: Sequence[str]
) -> tuple[list[Array], list[float]]:
    """Joints (3,) of the feet that may stand, m, and probabilities that they do."""
    places = {name: place for place, name in enumerate(joint_names)}
    points, shares = [], []
    for foot, probability in content.contacts.items():
        side = foot.removesuffix('_foot')
        for joint in _JOINTS:
            place = places.get(f'{side}_{joint}')
            if place is not None and probability >= _LEAST:
                points.append(positions[place])
                shares.append(probability)
    return points, shares


def _floor(messages: MessageFactory, header: Any, plane: Array, over: Array) -> Any:
    """The square under a point (3,)."""
    up, height = plane[:3], plane[3]
    across = np.eye(3)[np.argmin(np.abs(up))]
    x = across - (across @ up) * up
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(up, x), up], axis=1)
    place = over - (over @ up + height + _THICK / 2) * up
    qx, qy, qz, qw = quaternions(rotation[None])[0].tolist()
    px, py, pz = place.tolist()
    return messages.create(
        'visualization_msgs/msg/Marker',
        header=header,
        ns=FLOOR,
        type=_CUBE,
        action=_ADD,
        pose=messages.create(
            'geometry_msgs/msg/Pose',
            position=messages.create('geometry_msgs/msg/Point', x=px, y=py, z=pz),
            orientation=messages.create('geometry_msgs/msg/Quaternion', x=qx, y=qy, z=qz, w=qw),
        ),
        scale=messages.create('geometry_msgs/msg/Vector3', x=_SIDE, y=_SIDE, z=_THICK),
        color=_colour(messages, *_FLOOR_COLOUR),
    )


def _deleted(messages: MessageFactory, header: Any, namespace: str) -> Any:
    return messages.create(
        'visualization_msgs/msg/Marker',
        header=header,
        ns=namespace,
        action=_DELETE,
        pose=messages.create('geometry_msgs/msg/Pose'),
    )


def _colour(messages: MessageFactory, r: float, g: float, b: float, a: float) -> Any:
    return messages.create('std_msgs/msg/ColorRGBA', r=r, g=g, b=b, a=a)
