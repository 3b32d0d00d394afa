"""visualization_msgs markers of the modes of a mixture as skeletons, and of the floor.

A mode of rank k (0 for the heaviest) has the namespace `mode_k` with two markers, 0 the bones and 1
the joints; lighter modes are fainter. A viewer thus replaces earlier markers. Every array contains
all ranks, and deletes the markers of unused ranks.

The floor is a translucent square in the namespace `floor`. Feet on the floor are spheres in the
namespace `contacts`; less probable contacts are fainter. The markers of an unknown floor and of
unknown contacts are deleted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from msg_tools.messages.ground import GroundState
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import Array, MessageError
from msg_tools.messages.message_types import MessageFactory
from msg_tools.messages.states import pose_message, quaternions

_ADD, _DELETE = 0, 2
_CUBE, _LINE_LIST, _SPHERE_LIST = 1, 5, 7
_BONES, _JOINTS = 0, 1

# The heaviest mode is orange and all other modes blue; colour-blind people can distinguish both.
_FIRST_COLOUR = (0.90, 0.45, 0.05)
_OTHER_COLOUR = (0.10, 0.45, 0.80)
_MIN_OPACITY = 0.12

FLOOR, CONTACTS = 'floor', 'contacts'
# Side and thickness of the floor marker, m; the top of the marker is the floor.
_FLOOR_SIDE, _FLOOR_THICKNESS = 3.0, 0.005
_FLOOR_COLOUR = (0.55, 0.55, 0.50), 0.30
_CONTACT_COLOUR = (0.00, 0.62, 0.45)
_SPHERE_DIAMETER = 0.09  # diameter, m
# Minimum probability of a shown contact.
_MIN_CONTACT_PROBABILITY = 0.05
# Suffixes of the joint names of a foot.
_FOOT_SUFFIXES = ('ankle', 'toe')


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
        joint_positions: (K, J, 3) joint positions, m.
        edges: bones, as pairs of joint names.
        weights: (K,) weights of the modes, in any order.
        ranks: maximum number of shown modes; lighter modes are left out.
        bone_width, joint_diameter: width of bones and diameter of joints, m.

    Raises:
        MessageError: inconsistent array shapes, or an edge with an unknown joint.
    """
    positions = np.asarray(joint_positions, dtype=np.float64)
    heavy = np.asarray(weights, dtype=np.float64)
    if positions.shape != (len(heavy), len(joint_names), 3):
        raise MessageError(
            f'markers: joint_positions has shape {positions.shape}, wanted '
            f'({len(heavy)}, {len(joint_names)}, 3)'
        )
    ends = _ends(joint_names, edges)
    width = messages.create('geometry_msgs/msg/Vector3', x=bone_width)
    size = _size(messages, joint_diameter)

    def shown(mode: int) -> list[dict[str, Any]]:
        points = messages.points(positions[mode])
        return [
            {'type': _LINE_LIST, 'scale': width, 'points': [points[i] for i in ends]},
            {'type': _SPHERE_LIST, 'scale': size, 'points': points},
        ]

    header = header_message(messages, stamp_ns, frame_id)
    return _ranked_markers(messages, header, namespace, heavy, ranks, shown)


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
    """visualization_msgs/MarkerArray of M trajectories: paths of some joints and the newest pose.

    As in `skeleton_markers`, a trajectory of rank k has the namespace `trajectory_k`, with the
    paths as marker 0 and the newest pose as marker 1.

    Args:
        joint_positions: (M, T, J, 3) joint positions in temporal order, m.
        traced: joints whose paths are drawn; unknown names are ignored.
        edges: bones, as pairs of joint names.
        weights: (M,) weights of the trajectories, in any order.
        ranks: maximum number of shown trajectories; lighter trajectories are left out.
        line_width: width of lines, m.

    Raises:
        MessageError: inconsistent array shapes, or an edge with an unknown joint.
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
    drawn = [index for index, name in enumerate(joint_names) if name in traced]
    scale = messages.create('geometry_msgs/msg/Vector3', x=line_width)

    def shown(at: int) -> list[dict[str, Any]]:
        places = [messages.points(positions[at, :, joint]) for joint in drawn]
        # Pairs of neighbouring positions, joint by joint.
        pieces = [place for path in places for pair in pairwise(path) for place in pair]
        newest = messages.points(positions[at, -1])
        return [
            {'type': _LINE_LIST, 'scale': scale, 'points': points}
            for points in (pieces, [newest[i] for i in ends])
        ]

    header = header_message(messages, stamp_ns, frame_id)
    return _ranked_markers(messages, header, namespace, heavy, ranks, shown)


def _ranked_markers(
    messages: MessageFactory,
    header: Any,
    namespace: str,
    weights: Array,
    ranks: int,
    shown: Callable[[int], list[dict[str, Any]]],
) -> Any:
    """visualization_msgs/MarkerArray of the heaviest modes, two markers each.

    Args:
        weights: (K,) weights of the modes.
        shown: returns the fields of the two markers of a mode; markers without points are deleted,
            for example the paths of a single pose.
    """
    blank = _marker(messages, header, action=_DELETE)
    order = np.argsort(-weights, kind='stable')[:ranks].tolist()
    markers = []
    for rank in range(ranks):
        pair: list[dict[str, Any]] = [{}, {}]
        if rank < len(order):
            pair = shown(order[rank])
            heaviest = float(weights[order[0]])
            share = float(weights[order[rank]]) / heaviest if heaviest > 0 else 1.0
            alpha = _MIN_OPACITY + (1 - _MIN_OPACITY) * share
            colour = _colour(messages, _OTHER_COLOUR if rank else _FIRST_COLOUR, alpha)
            pair = [
                {'action': _ADD if x['points'] else _DELETE, 'color': colour, **x} for x in pair
            ]
        for key, fields in enumerate(pair):
            made = copy(blank)
            for name, value in {'ns': f'{namespace}_{rank}', 'id': key, **fields}.items():
                setattr(made, name, value)
            markers.append(made)
    return messages.create('visualization_msgs/msg/MarkerArray', markers=markers)


def _marker(messages: MessageFactory, header: Any, **fields: Any) -> Any:
    """Makes a visualization_msgs/Marker with a valid orientation, which viewers require."""
    fields.setdefault('pose', messages.create('geometry_msgs/msg/Pose'))
    return messages.create('visualization_msgs/msg/Marker', header=header, **fields)


def _size(messages: MessageFactory, diameter: float) -> Any:
    return messages.create('geometry_msgs/msg/Vector3', x=diameter, y=diameter, z=diameter)


def _ends(joint_names: Sequence[str], edges: Sequence[tuple[str, str]]) -> list[int]:
    """Indices of the joints at both ends of each bone, bone by bone."""
    index = {name: i for i, name in enumerate(joint_names)}
    for edge in edges:
        for name in edge:
            if name not in index:
                raise MessageError(f'markers: edge {edge} has the unknown joint {name!r}')
    return [index[name] for edge in edges for name in edge]


def ground_markers(
    messages: MessageFactory,
    content: GroundState,
    joint_positions: ArrayLike,
    joint_names: Sequence[str],
) -> list[Any]:
    """visualization_msgs/Marker of the floor and of the contacts of one pose.

    Args:
        joint_positions: (J, 3) joint positions, m, in the frame of the content; the floor is drawn
            below their mean.
        joint_names: (J,) names of the joints; a foot without ankle or toe is left out.
    """
    positions = np.asarray(joint_positions, dtype=np.float64)
    header = header_message(messages, content.stamp_ns, content.frame_id)
    floor, contacts = removed_ground(messages, content.stamp_ns, content.frame_id)
    if content.plane is not None:
        floor = _floor(messages, header, content.plane, positions.mean(0))
    points, shares = _standing(content, positions, joint_names)
    if points:
        contacts = _marker(
            messages,
            header,
            ns=CONTACTS,
            type=_SPHERE_LIST,
            action=_ADD,
            scale=_size(messages, _SPHERE_DIAMETER),
            color=_colour(messages, _CONTACT_COLOUR, 1.0),
            points=messages.points(np.array(points)),
            colors=[_colour(messages, _CONTACT_COLOUR, share) for share in shares],
        )
    return [floor, contacts]


def removed_ground(messages: MessageFactory, stamp_ns: int, frame_id: str) -> list[Any]:
    """List of visualization_msgs/Marker that delete the markers of `ground_markers`."""
    header = header_message(messages, stamp_ns, frame_id)
    return [_marker(messages, header, ns=name, action=_DELETE) for name in (FLOOR, CONTACTS)]


def _standing(
    content: GroundState, positions: Array, joint_names: Sequence[str]
) -> tuple[list[Array], list[float]]:
    """Joint positions (3,) of feet with a likely floor contact, m, and contact probabilities."""
    places = {name: place for place, name in enumerate(joint_names)}
    points, shares = [], []
    for foot, probability in content.contacts.items():
        side = foot.removesuffix('_foot')
        for joint in _FOOT_SUFFIXES:
            place = places.get(f'{side}_{joint}')
            if place is not None and probability >= _MIN_CONTACT_PROBABILITY:
                points.append(positions[place])
                shares.append(probability)
    return points, shares


def _floor(messages: MessageFactory, header: Any, plane: Array, over: Array) -> Any:
    """Marker of the floor: a square below a point (3,)."""
    up, height = plane[:3], plane[3]
    across = np.eye(3)[np.argmin(np.abs(up))]
    x = across - (across * up).sum() * up
    x /= np.linalg.norm(x, axis=0)
    rotation = np.stack([x, np.cross(up, x), up], axis=1)
    place = over - ((over * up).sum() + height + _FLOOR_THICKNESS / 2) * up
    return _marker(
        messages,
        header,
        ns=FLOOR,
        type=_CUBE,
        action=_ADD,
        pose=pose_message(messages, place, quaternions(rotation[None])[0]),
        scale=messages.create(
            'geometry_msgs/msg/Vector3', x=_FLOOR_SIDE, y=_FLOOR_SIDE, z=_FLOOR_THICKNESS
        ),
        color=_colour(messages, *_FLOOR_COLOUR),
    )


def _colour(messages: MessageFactory, colour: tuple[float, float, float], alpha: float) -> Any:
    r, g, b = colour
    return messages.create('std_msgs/msg/ColorRGBA', r=r, g=g, b=b, a=alpha)
