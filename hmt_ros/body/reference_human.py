"""The reference human model of REP 155, fitted to joint positions.

Frames: the body has x forward, y to the left, z up, its origin midway between the hips. At zero
angles the person stands upright with hanging arms and legs. Joints, parent links and axes follow
`human-tpl.xacro` of the package human_description:

    body -waist-> waist -(r_torso, y_torso)-> torso      y; then x and z, which are added
    torso -r_head, y_head, p_head-> head                 x, z, -y
    torso -(l_clavicle)-> l_y_shoulder ... l_shoulder    x, added; then -z, x, z (right: mirrored)
    l_shoulder -l_elbow-> l_elbow -> l_wrist             -y
    body -l_y_hip, l_p_hip, l_r_hip-> l_hip              -z, x, -y (right: only x is mirrored)
    l_hip -l_knee-> l_knee -> l_ankle                    -y

In the reference the trunk only leans forward, and the shoulders are fixed to it. The four added
joints let the trunk bend sideways and twist and the shoulders lift, so that the model passes
through all joint positions; `additions=False` leaves them out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import length, product

# Joints of the reference and their ranges, rad.
_LIMB_RANGES = {
    '{}_y_shoulder': (-1.1, 1.9),
    '{}_p_shoulder': (-0.4, 3.3),
    '{}_r_shoulder': (-1.7, 1.5),
    '{}_elbow': (0.0, 2.5),
    '{}_y_hip': (-0.1, 0.6),
    '{}_p_hip': (-0.4, 3.3),
    '{}_r_hip': (-0.4, 0.7),
    '{}_knee': (-2.5, 0.0),
}
RANGES = {
    'waist': (-0.2, 1.0),
    'r_head': (-1.0, 1.0),
    'y_head': (-1.4, 1.4),
    'p_head': (-1.5, 1.5),
    **{name.format(side): x for side in 'lr' for name, x in _LIMB_RANGES.items()},
}
REFERENCE_JOINTS = tuple(RANGES)
ADDED_JOINTS = ('r_torso', 'y_torso', 'l_clavicle', 'r_clavicle')
SIDES = {'l': ('left', 1.0), 'r': ('right', -1.0)}
# Joints of our bodies that the model needs.
NEEDED_JOINTS = (
    'pelvis',
    'neck',
    'head',
    *(
        f'{side}_{joint}'
        for side, _ in SIDES.values()
        for joint in ('hip', 'knee', 'ankle', 'shoulder', 'elbow', 'wrist')
    ),
)
# Sine of the angle below which two bones count as parallel; length that counts as zero, m.
_PARALLEL_SINE, _ZERO_LENGTH = 1e-4, 1e-3
# Angle by which our bodies have the hips in front of the vertical through the pelvis joint, rad.
HIP_ANGLE = elementary.arctan(0.33)
# Weight of the change of an angle between images, relative to its excess over the range.
_CHANGE_WEIGHT = 0.2


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint of the model, between two links.

    Attributes:
        name: name of the joint, without the body's identifier.
        parent, child: names of the links.
        origin: (3,) origin of the child in the frame of the parent, m.
        axis: (3,) unit vector; None for a fixed joint.
    """

    name: str
    parent: str
    child: str
    origin: Array
    axis: Array | None


@dataclass(frozen=True, eq=False)
class ReferenceHuman:
    """The model of one person in one pose.

    Attributes:
        joints: joints of the model at the person's lengths, parents before their children.
        angles: angle of each movable joint, in [-pi, pi), rad.
        rotation: (3, 3) from the body's frame to the frame of the joint positions.
        origin: (3,) origin of the body, m.
    """

    joints: tuple[Joint, ...]
    angles: dict[str, float]
    rotation: Array
    origin: Array

    def links(self) -> tuple[list[str], Array, Array]:
        """Return names (L), rotations (L, 3, 3) and origins (L, 3), m, of links except the body.

        Rotations and origins are in the frame of the body.
        """
        frames = {'body': (np.eye(3), np.zeros(3))}
        for joint in self.joints:
            rotation, place = frames[joint.parent]
            place = place + product(rotation, joint.origin)
            if joint.axis is not None:
                rotation = product(rotation, _turn(joint.axis, self.angles[joint.name]))
            frames[joint.child] = (rotation, place)
        del frames['body']
        rotations, places = zip(*frames.values(), strict=True)
        return list(frames), np.array(rotations), np.array(places)


def fit_reference_human(
    names: Sequence[str],
    positions: Array,
    previous: Mapping[str, float] | None = None,
    *,
    additions: bool = True,
) -> ReferenceHuman:
    """Fit the reference model to joint positions.

    Two sets of angles give the same direction of a limb; the set within the ranges of the reference
    and near the previous angles is chosen. Angles that positions do not determine keep their
    previous values: the roll of a straight limb, the yaw of a limb that hangs straight down.
    Positions never determine the turn of the head: `y_head` is 0.

    Args:
        names: (J) names of the joints.
        positions: (J, 3) positions in any right-handed frame, m.
        previous: angles in the previous image; None: all zero.
        additions: whether the model has the added joints. Without these joints, limbs keep their
            directions, and the shoulders are placed as in the reference.

    Raises:
        ValueError: a required joint is missing, or the two joints of a bone coincide.
    """
    missing = [name for name in NEEDED_JOINTS if name not in names]
    if missing:
        raise ValueError(f'joint positions of {", ".join(missing)} are missing')
    at = {name: positions[list(names).index(name)] for name in NEEDED_JOINTS}
    before = dict.fromkeys((*REFERENCE_JOINTS, *ADDED_JOINTS), 0.0) | dict(previous or {})
    origin = (at['left_hip'] + at['right_hip']) / 2
    rotation = _body_axes(at, origin)
    in_body = {name: product(rotation.T, place - origin) for name, place in at.items()}
    # The trunk starts above the middle of the hips, in front of the pelvis joint.
    in_body['pelvis'] = in_body['pelvis'] * [0.0, 1.0, 1.0]
    angles: dict[str, float] = {}
    torso = _fit_trunk(in_body, angles, additions=additions)
    head = product(torso.T, _direction(in_body, 'neck', 'head'))
    angles['p_head'] = float(elementary.arcsin(np.clip(-head[0], -1.0, 1.0)))
    angles['r_head'] = float(elementary.arctan2(-head[1], head[2]))
    angles['y_head'] = 0.0
    ahead = {side: 0.0 for side, _ in SIDES.values()}
    for letter, (side, sign) in SIDES.items():
        if additions:
            ahead[side], out, up = product(torso.T, in_body[f'{side}_shoulder'] - in_body['neck'])
            angles[f'{letter}_clavicle'] = float(elementary.arctan2(up, sign * out))
        lifted = angles.get(f'{letter}_clavicle', 0.0)
        base = product(torso, _turn(np.array([sign, 0.0, 0.0]), lifted))
        _fit_arm(in_body, letter, base, before, angles)
        _fit_leg(in_body, letter, before, angles)
    joints = _joints(in_body, ahead, additions=additions)
    ordered = {j.name: angles[j.name] for j in joints if j.axis is not None}
    return ReferenceHuman(joints, ordered, rotation, origin)


def _direction(at: Mapping[str, Array], first: str, last: str) -> Array:
    """Unit vector (3,) from one joint to another."""
    return _unit(at[last] - at[first], f'{first} and {last}')


def _unit(vector: Array, what: str) -> Array:
    size = length(vector)
    if not size > _ZERO_LENGTH:
        raise ValueError(f'{what} are at one place: they have no direction')
    result: Array = vector / size
    return result


def _body_axes(at: Mapping[str, Array], origin: Array) -> Array:
    """Return axes (3, 3), in columns: forward, from right to left hip, and up the pelvis."""
    y = _direction(at, 'right_hip', 'left_hip')
    up = at['pelvis'] - origin
    up = elementary.cos(HIP_ANGLE) * up + elementary.sin(HIP_ANGLE) * np.cross(y, up)
    if length(up - y * product(y, up)) < _ZERO_LENGTH:
        up = at['neck'] - origin
    z = _unit(up - y * product(y, up), 'the line of the hips and the trunk')
    return np.stack([np.cross(y, z), y, z], axis=1)


def _fit_trunk(at: Mapping[str, Array], angles: dict[str, float], *, additions: bool) -> Array:
    """Set the angles of the trunk; return the axes (3, 3) of the torso in the body's frame."""
    z = _direction(at, 'pelvis', 'neck')
    if not additions:
        angles['waist'] = float(elementary.arctan2(z[0], z[2]))
        return _turn(np.array([0.0, 1.0, 0.0]), angles['waist'])
    across = at['left_shoulder'] - at['right_shoulder']
    y = _unit(across - z * product(z, across), 'the shoulders')
    r = np.stack([np.cross(y, z), y, z], axis=1)
    # r = Ry(waist) Rx(r_torso) Rz(y_torso)
    angles['waist'] = float(elementary.arctan2(r[0, 2], r[2, 2]))
    angles['r_torso'] = float(elementary.arcsin(np.clip(-r[1, 2], -1.0, 1.0)))
    angles['y_torso'] = float(elementary.arctan2(r[1, 0], r[1, 1]))
    return r


def _fit_arm(
    at: Mapping[str, Array],
    letter: str,
    base: Array,
    before: Mapping[str, float],
    angles: dict[str, float],
) -> None:
    """Set the angles of an arm whose shoulder has the axes `base` (3, 3).

    Upper arm: Rz(-s a) Rx(s b) Rz(s c), with s = 1 on the left and -1 on the right.
    """
    side, s = SIDES[letter]
    names = [f'{letter}_{axis}_shoulder' for axis in 'ypr']
    upper = product(base.T, _direction(at, f'{side}_shoulder', f'{side}_elbow'))
    lower = product(base.T, _direction(at, f'{side}_elbow', f'{side}_wrist'))
    bend = np.cross(lower, upper)
    sine = length(bend)
    angles[f'{letter}_elbow'] = float(elementary.arctan2(sine, product(upper, lower)))
    b = float(elementary.arctan2(elementary.hypot(upper[0], upper[1]), -upper[2]))
    hangs = elementary.sin(b) < _PARALLEL_SINE
    a = before[names[0]] if hangs else float(elementary.arctan2(upper[0], s * upper[1]))
    c = before[names[2]]
    if sine > _PARALLEL_SINE:
        # The elbow bends forward: its axis is the y axis of the upper arm.
        axis = product(product(_turn_z(-s * a), _turn_x(s * b)).T, bend / sine)
        c = s * float(elementary.arctan2(-axis[0], axis[1]))
    found = [(a, b, c), (a + np.pi, -b, c + np.pi)]
    angles.update(zip(names, _best_angles(found, names, before), strict=True))


def _fit_leg(
    at: Mapping[str, Array], letter: str, before: Mapping[str, float], angles: dict[str, float]
) -> None:
    """Set the angles of a leg; thigh Rz(-a) Rx(s b) Ry(-c), s = 1 on the left, -1 on the right."""
    side, s = SIDES[letter]
    names = [f'{letter}_{axis}_hip' for axis in 'ypr']
    thigh = _direction(at, f'{side}_hip', f'{side}_knee')
    shin = _direction(at, f'{side}_knee', f'{side}_ankle')
    bend = np.cross(thigh, shin)
    sine = length(bend)
    angles[f'{letter}_knee'] = -float(elementary.arctan2(sine, product(thigh, shin)))
    found = []
    if sine > _PARALLEL_SINE:
        # The knee bends backward: its axis is the y axis of the thigh, (-sin, cos cos, sin).
        y = bend / sine
        b = float(elementary.arcsin(np.clip(y[2], -1.0, 1.0)))
        level = elementary.hypot(y[0], y[1]) > _PARALLEL_SINE
        a = float(elementary.arctan2(y[0], y[1])) if level else before[names[0]]
        turns = [(a, b), (a + np.pi, np.pi - b)]
    else:
        # Keep the last yaw; the direction of the thigh is Rz(-a) Rx(s b) (sin c, 0, -cos c).
        a = before[names[0]]
        x, y_, z = product(_turn_z(a), thigh)
        turns = [(a, float(elementary.arctan2(y_, -z))), (a, float(elementary.arctan2(-y_, z)))]
    for a, b in turns:
        x, _, z = product(product(_turn_z(-a), _turn_x(b)).T, thigh)
        found.append((a, s * b, float(elementary.arctan2(x, -z))))
    angles.update(zip(names, _best_angles(found, names, before), strict=True))


def _best_angles(
    found: Sequence[tuple[float, ...]], names: Sequence[str], before: Mapping[str, float]
) -> tuple[float, ...]:
    """Choose the set of angles with the least excess over the ranges and the least change."""

    def cost(each: tuple[float, ...]) -> float:
        terms = zip(each, (RANGES[name] for name in names), names, strict=True)
        return sum(
            max(lo - x, x - hi, 0.0) + _CHANGE_WEIGHT * abs(_wrapped(x - before[name]))
            for x, (lo, hi), name in terms
        )

    return min((tuple(map(_wrapped, each)) for each in found), key=cost)


def _wrapped(angle: float) -> float:
    """Wrap an angle to [-pi, pi)."""
    return float((angle + np.pi) % (2 * np.pi) - np.pi)


def _joints(
    at: Mapping[str, Array], ahead: Mapping[str, float], *, additions: bool
) -> tuple[Joint, ...]:
    """Return the joints of the model, with lengths from joint positions in the body's frame.

    Args:
        ahead: distance of the shoulders in front of the neck, by side, m.
    """

    def distance(first: str, last: str) -> float:
        return length(at[last] - at[first])

    trunk, head = distance('pelvis', 'neck'), distance('neck', 'head')
    result = [
        # In the reference the trunk leans about the hips.
        _joint('waist', 'body', 'waist', (0, 0, float(at['pelvis'][2])), (0, 1, 0)),
    ]
    if additions:
        result += [
            _joint('r_torso', 'waist', 'r_torso', (0, 0, 0), (1, 0, 0)),
            _joint('y_torso', 'r_torso', 'y_torso', (0, 0, 0), (0, 0, 1)),
        ]
    result += [
        _joint('torso', 'y_torso' if additions else 'waist', 'torso', (0, 0, trunk), None),
        _joint('r_head', 'torso', 'r_head', (0, 0, 0), (1, 0, 0)),
        _joint('y_head', 'r_head', 'y_head', (0, 0, 0), (0, 0, 1)),
        _joint('p_head', 'y_head', 'p_head', (0, 0, 0), (0, -1, 0)),
        _joint('head', 'p_head', 'head', (0, 0, head), None),
    ]
    for x, (side, s) in SIDES.items():
        out = math.sqrt(max(distance('neck', f'{side}_shoulder') ** 2 - ahead[side] ** 2, 0.0))
        shoulder = (ahead[side], s * out, 0)
        arm = (0, 0, -distance(f'{side}_shoulder', f'{side}_elbow'))
        forearm = (0, 0, -distance(f'{side}_elbow', f'{side}_wrist'))
        hip = (0, s * distance('left_hip', 'right_hip') / 2, 0)
        thigh = (0, 0, -distance(f'{side}_hip', f'{side}_knee'))
        shin = (0, 0, -distance(f'{side}_knee', f'{side}_ankle'))
        upper, yaw, pitch = f'{x}_shoulder', f'{x}_y_shoulder', f'{x}_p_shoulder'
        clavicle = f'{x}_clavicle'
        if additions:
            result.append(_joint(clavicle, 'torso', clavicle, (0, 0, 0), (s, 0, 0)))
        result += [
            _joint(yaw, clavicle if additions else 'torso', yaw, shoulder, (0, 0, -s)),
            _joint(pitch, yaw, pitch, (0, 0, 0), (s, 0, 0)),
            _joint(f'{x}_r_shoulder', pitch, upper, (0, 0, 0), (0, 0, s)),
            _joint(f'{x}_elbow', upper, f'{x}_elbow', arm, (0, -1, 0)),
            _joint(f'{x}_wrist', f'{x}_elbow', f'{x}_wrist', forearm, None),
            _joint(f'{x}_y_hip', 'body', f'{x}_y_hip', hip, (0, 0, -1)),
            _joint(f'{x}_p_hip', f'{x}_y_hip', f'{x}_p_hip', (0, 0, 0), (s, 0, 0)),
            _joint(f'{x}_r_hip', f'{x}_p_hip', f'{x}_hip', (0, 0, 0), (0, -1, 0)),
            _joint(f'{x}_knee', f'{x}_hip', f'{x}_knee', thigh, (0, -1, 0)),
            _joint(f'{x}_ankle', f'{x}_knee', f'{x}_ankle', shin, None),
        ]
    return tuple(result)


def _joint(
    name: str,
    parent: str,
    child: str,
    origin: Sequence[float],
    axis: Sequence[float] | None,
) -> Joint:
    turns = None if axis is None else np.array(axis, dtype=np.float64)
    return Joint(name, parent, child, np.array(origin, dtype=np.float64), turns)


def _turn(axis: Array, angle: float) -> Array:
    """Rotation (3, 3) about a unit vector; Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    result: Array = (
        np.eye(3)
        + elementary.sin(angle) * cross
        + (1.0 - elementary.cos(angle)) * product(cross, cross)
    )
    return result


def _turn_x(angle: float) -> Array:
    return _turn(np.array([1.0, 0.0, 0.0]), angle)


def _turn_z(angle: float) -> Array:
    return _turn(np.array([0.0, 0.0, 1.0]), angle)
