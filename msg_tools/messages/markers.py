"""visualization_msgs: the modes of a mixture as skeletons, the lighter the fainter; the floor.

A mode of rank k (0: the heaviest) has the namespace `mode_k` with two markers, 0 the bones and 1
the joints. So a viewer replaces the markers of the last time, and ranks that are not used any more
are deleted: every array speaks about all ranks.

The floor is a translucent square in the namespace `floor`, the feet that stand on it are spheres in
the namespace `contacts`, the less probable the fainter. Markers of unknown things are deleted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msg_tools.messages.ground import GroundState
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import MessageError
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.states import pose_message, quaternions

_ADD, _DELETE = 0, 2
_CUBE, _LINE_LIST, _SPHERE_LIST = 1, 5, 7
_BONES, _JOINTS = 0, 1

# The heaviest mode is orange, the others are blue: both are told apart by colour-blind people.
_FIRST = (0.90, 0.45, 0.05)
_OTHERS = (0.10, 0.45, 0.80)
_FAINTEST = 0.12

FLOOR, CONTACTS = 'floor', 'contacts'
# Side and thickness of the square, m; its top is the floor.
_SIDE, _THICK = 3.0, 0.005
_FLOOR_COLOUR = (0.55, 0.55, 0.50, 0.30)
_CONTACT_COLOUR = (0.00, 0.62, 0.45)
_SPHERE = 0.09  # diameter, m
# A foot that stands with a lower probability is not shown.
_LEAST = 0.05
# Joints of a foot, by the end of its name.
_OF_FOOT = ('ankle', 'toe')

Array = NDArray[np.float64]


def skeleton_markers(
    messages: MessageFactory,
    joint_positions: ArrayLike,
    joint_names: Sequence[str],
    edges: Sequence[tuple[str, str]],
    weights: ArrayLike,
    stamp_ns: int,
    frame_id: str,
    *,
    ranks: int,
    namespace: str = 'mode',
    bone_width: float = 0.02,
    joint_diameter: float = 0.05,
) -> Any:
    """visualization_msgs/MarkerArray of K modes.

    Args:
        joint_positions: (K, J, 3) m.
        edges: bones, as the names of the joints that they join.
        weights: (K,) of the modes, in any order.
        ranks: most modes that ever are shown; the lightest beyond are left out.
        bone_width, joint_diameter: m.

    Raises:
        MessageError: arrays whose lengths contradict each other, an edge of an unknown joint.
    """
    positions = np.asarray(joint_positions, dtype=np.float64)
    heavy = np.asarray(weights, dtype=np.float64)
    if positions.shape != (len(heavy), len(joint_names), 3):
        raise MessageError(
            f'markers: joint_positions has shape {positions.shape}, wanted '
            f'({len(heavy)}, {len(joint_names)}, 3)'
        )
    ends = _ends(joint_names, edges)
    order = np.argsort(-heavy, kind='stable')[:ranks]
    header = header_message(messages, stamp_ns, frame_id)

    marker = _markers(messages, header, namespace)
    markers = []
    for rank, mode in enumerate(order):
        points = messages.points(positions[mode])
        color = _color(messages, rank, heavy[mode], heavy[order[0]])
        markers.append(
            marker(
                rank,
                _BONES,
                type=_LINE_LIST,
                action=_ADD,
                scale=messages.create('geometry_msgs/msg/Vector3', x=bone_width),
                color=color,
                points=[points[i] for i in ends],
            )
        )
        markers.append(
            marker(
                rank,
                _JOINTS,
                type=_SPHERE_LIST,
                action=_ADD,
                scale=messages.create(
                    'geometry_msgs/msg/Vector3',
                    x=joint_diameter,
                    y=joint_diameter,
                    z=joint_diameter,
                ),
                color=color,
                points=points,
            )
        )
    for rank in range(len(order), ranks):
        markers.extend(marker(rank, key, action=_DELETE) for key in (_BONES, _JOINTS))
    return messages.create('visualization_msgs/msg/MarkerArray', markers=markers)


def trajectory_markers(
    messages: MessageFactory,
    joint_positions: ArrayLike,
    joint_names: Sequence[str],
    traced: Sequence[str],
    edges: Sequence[tuple[str, str]],
    weights: ArrayLike,
    stamp_ns: int,
    frame_id: str,
    *,
    ranks: int,
    namespace: str = 'trajectory',
    line_width: float = 0.01,
) -> Any:
    """visualization_msgs/MarkerArray of M trajectories: the paths of some joints, the newest pose.

    As `skeleton_markers`: a trajectory of rank k has the namespace `trajectory_k`, with the paths
    as marker 0 and the newest pose as marker 1.

    Args:
        joint_positions: (M, T, J, 3) m, in the order of time.
        traced: joints whose paths are drawn; those that are no joints are left out.
        edges: bones, as the names of the joints that they join.
        weights: (M,) of the trajectories, in any order.
        ranks: most trajectories that ever are shown; the lightest beyond are left out.
        line_width: m.

    Raises:
        MessageError: arrays whose lengths contradict each other, an edge of an unknown joint.
    """
    positions = np.asarray(joint_positions, dtype=np.float64)
    heavy = np.asarray(weights, dtype=np.float64)
    if positions.ndim != 4 or (len(positions), *positions.shape[2:]) != (
        len(heavy),
        len(joint_names),
        3,
    ):
        raise MessageError(
            f'markers: joint_positions has shape {positions.shape}, wanted '
            f'({len(heavy)}, T, {len(joint_names)}, 3)'
        )
    ends = _ends(joint_names, edges)
    shown = [index for index, name in enumerate(joint_names) if name in traced]
    header = header_message(messages, stamp_ns, frame_id)
    marker = _markers(messages, header, namespace)
    scale = messages.create('geometry_msgs/msg/Vector3', x=line_width)
    order = np.argsort(-heavy, kind='stable')[:ranks]
    markers = []
    for rank, at in enumerate(order):
        places = [messages.points(positions[at, :, joint]) for joint in shown]
        # Pairs of neighbouring positions, joint by joint.
        pieces = [place for path in places for pair in pairwise(path) for place in pair]
        newest = messages.points(positions[at, -1])
        color = _color(messages, rank, heavy[at], heavy[order[0]])
        for key, points in ((0, pieces), (1, [newest[i] for i in ends])):
            markers.append(
                marker(
                    rank,
                    key,
                    # One point alone is no line.
                    action=_ADD if points else _DELETE,
                    type=_LINE_LIST,
                    scale=scale,
                    color=color,
                    points=points,
                )
            )
    for rank in range(len(order), ranks):
        markers.extend(marker(rank, key, action=_DELETE) for key in (0, 1))
    return messages.create('visualization_msgs/msg/MarkerArray', markers=markers)


def _markers(messages: MessageFactory, header: Any, namespace: str) -> Callable[..., Any]:
    """Maker of the markers of one array, which share their common fields."""
    blank = messages.create(
        'visualization_msgs/msg/Marker',
        header=header,
        # Viewers complain about an orientation of zero length.
        pose=messages.create('geometry_msgs/msg/Pose'),
    )

    def marker(rank: int, key: int, **fields: Any) -> Any:
        made = copy(blank)
        for name, value in {'ns': f'{namespace}_{rank}', 'id': key, **fields}.items():
            setattr(made, name, value)
        return made

    return marker


def _ends(joint_names: Sequence[str], edges: Sequence[tuple[str, str]]) -> list[int]:
    """Indices of the joints at both ends of the bones, one after the other."""
    index = {name: i for i, name in enumerate(joint_names)}
    for edge in edges:
        for name in edge:
            if name not in index:
                raise MessageError(f'markers: edge {edge} has the unknown joint {name!r}')
    return [index[name] for edge in edges for name in edge]


def _color(messages: MessageFactory, rank: int, weight: float, heaviest: float) -> Any:
    """std_msgs/ColorRGBA of a rank, the lighter the fainter."""
    red, green, blue = _OTHERS if rank else _FIRST
    share = float(weight / heaviest) if heaviest > 0 else 1.0
    return messages.create(
        'std_msgs/msg/ColorRGBA', r=red, g=green, b=blue, a=_FAINTEST + (1 - _FAINTEST) * share
    )


def ground_markers(
    messages: MessageFactory,
    content: GroundState,
    joint_positions: ArrayLike,
    joint_names: Sequence[str],
) -> list[Any]:
    """visualization_msgs/Marker of the floor and of the contacts of one pose.

    Args:
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
        for joint in _OF_FOOT:
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
    return messages.create(
        'visualization_msgs/msg/Marker',
        header=header,
        ns=FLOOR,
        type=_CUBE,
        action=_ADD,
        pose=pose_message(messages, place, quaternions(rotation[None])[0]),
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
