"""Poses from joint positions, in closed form and frame by frame, to initialise retargeting.

The solution of KJS 3 proceeds from the trunk outwards. With v the direction from the end of a
segment to its start, in the segment's frame before its rotations,

    v = (sin b, -sin a cos b, cos a cos b)

gives the first two angles, independent of the lengths. The third angle, the twist, follows from the
next segments or, if these are straight, from neighbouring frames. The result lies within the
limits. It is exact if the body has the same lengths and can reach the pose, else approximate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import root_rotation_dofs, rotations_of
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import determinant, length, product, singular_values

SIDES = ('left', 'right')
ARM = ('shoulder', 'elbow', 'wrist', 'hand')
LEG = ('hip', 'knee', 'ankle', 'toe')
# Weights of the cues for the twist of a limb; a hinge bent by a right angle has weight 1.
FOOT_WEIGHT = 0.3  # direction of the foot, for the leg
NEIGHBOUR_WEIGHT, AROUND_TIME = 0.2, 0.2  # neighbouring frames; smoothing time, s
ZERO_TWIST_WEIGHT = 1e-3  # zero twist, the default
HIPS = ('pelvis', 'left_hip', 'right_hip')
TRUNK_START = 'start of the trunk'
FLEXIBLE_WEIGHT = 0.05  # weight of neck and shoulders in the fit of the root, if the trunk can bend


def limb_angles(skeleton: Skeleton, place: Mapping[str, Array], fps: float | None) -> Array:
    """Fit poses (T, d) to joint positions with standard names.

    Args:
        skeleton: skeleton with the limbs of KJS fig. 3, such as the skeletons of the shipped
            bodies.
        place: positions (T, 3) of each joint, camera frame, m; toes and hands may be missing.
        fps: frames per second of a sequence, in which headings are unwrapped; None for independent
            poses.

    Raises:
        ValueError: the skeleton has other limbs.
    """
    count = len(place['pelvis'])
    aims = _aims(skeleton)
    place = {**place, TRUNK_START: trunk_start(skeleton, place)}
    poses = np.zeros((count, skeleton.dimension))
    turns: dict[int, Array] = {}  # segment -> rotation (T, 3, 3) to the camera frame
    for s, parent in enumerate(skeleton.parents):
        if parent < 0:
            turns[s] = _set_root(skeleton, place, poses)
            if fps is not None:
                heading = root_rotation_dofs(skeleton)[0]
                poses[:, heading] = np.unwrap(poses[:, heading])
            continue
        turn = product(turns[parent], skeleton.mounts[s])
        own, axes = rotations_of(skeleton, s)
        if s in aims and axes:
            start, end, next_end = aims[s]
            if axes not in ('xyz', 'xy', 'x'):
                raise ValueError(
                    f'{skeleton.name}: {skeleton.segment_names[s]} turns about {axes!r}, wanted x, '
                    f'xy or xyz'
                )
            if start in place and end in place:
                along = _local(turn, place[start] - place[end])
                a = elementary.arctan2(-along[:, 1], along[:, 2])
                poses[:, own[0]] = a
                if len(axes) > 1:
                    poses[:, own[1]] = elementary.arcsin(np.clip(along[:, 0], -1.0, 1.0))
            turn = _turned(skeleton, own[:2], poses, turn)
            if len(axes) == 3:
                poses[:, own[2]] = _twist(skeleton, s, turn, place, next_end, fps)
                turn = _turned(skeleton, own[2:], poses, turn)
        turns[s] = turn
    return _within(poses, skeleton)


def trunk_start(skeleton: Skeleton, place: Mapping[str, Array]) -> Array:
    """Return the start of the trunk (T, 3), from the pelvis and the hips.

    Its offset from the pelvis, relative to the distance from pelvis to hips, is as in the rest
    pose.
    """
    if 'neck' not in skeleton.chains:
        return place['pelvis']
    trunk = skeleton.parents[skeleton.chains['neck'][0]]
    frames = forward(skeleton, np.zeros((1, skeleton.dimension)))
    rest = frames.joints()[skeleton.joint_index(HIPS)].transpose(0, 2, 1)
    offset = frames.origins[trunk, :, 0] - rest[0, 0]
    at_rest = np.einsum('tij,i->tj', _pelvis_axes(*rest), offset)[0]
    drop = length(rest[1:].mean(0) - rest[0])
    places = [place[name] for name in HIPS]
    drops = np.linalg.norm(0.5 * (places[1] + places[2]) - places[0], axis=1)
    shift = np.einsum('tij,j->ti', _pelvis_axes(*places), at_rest / max(float(drop), 1e-9))
    result: Array = places[0] + drops[:, None] * shift
    return result


def _pelvis_axes(pelvis: Array, left: Array, right: Array) -> Array:
    """Axes (T, 3, 3), in columns: from pelvis to hips, to the right, perpendicular to both."""
    down, across = 0.5 * (left + right) - pelvis, right - left
    down = down / np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-9)
    across = across - (across * down).sum(1, keepdims=True) * down
    across = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    return np.stack([down, across, np.cross(down, across)], axis=2)


Aim = tuple[str, str, str]


def _aims(skeleton: Skeleton) -> dict[int, Aim]:
    """Return three joints per aimed segment: at its start, its end and the next segment's end."""
    result: dict[int, Aim] = {}
    try:
        head = skeleton.chains['neck'][0]
        for side in SIDES:
            for limb, joints in (('arm', ARM), ('leg', LEG)):
                first, second, third = skeleton.chains[f'{side}_{limb}']
                a, b, c, d = (f'{side}_{joint}' for joint in joints)
                result |= {first: (a, b, c), second: (b, c, d), third: (c, d, '')}
    except (KeyError, ValueError):
        raise ValueError(
            f'{skeleton.name} has chains {dict(skeleton.chains)}, wanted a neck and four limbs of '
            f'three segments each'
        ) from None
    result[head] = ('neck', 'head', '')
    trunk = skeleton.parents[head]
    if skeleton.parents[trunk] >= 0:
        result[trunk] = (TRUNK_START, 'neck', '')
    return result


def _set_root(skeleton: Skeleton, place: Mapping[str, Array], poses: Array) -> Array:
    """Set the root's degrees of freedom from the joints of the trunk; return its rotation."""
    rotations = root_rotation_dofs(skeleton)
    shifts = skeleton.dof_index(('root_tx', 'root_ty', 'root_tz'))
    flexible = bool(skeleton.moves[skeleton.chains['neck'][0]].sum() > 8)  # root and neck give 8
    names = ['pelvis', 'left_hip', 'right_hip', 'neck', 'left_shoulder', 'right_shoulder']
    weights = np.array([1.0, 1.0, 1.0, *([FLEXIBLE_WEIGHT if flexible else 1.0] * 3)])
    at_rest = forward(skeleton, np.zeros((1, skeleton.dimension))).joints()[..., 0]
    rest = at_rest[skeleton.joint_index(tuple(names))]
    seen = np.stack([place[n] for n in names], axis=1)
    turn = _aligned(rest, seen, weights)
    poses[:, shifts] = place['pelvis']
    rotation: Array = product(turn, skeleton.mounts[0])
    own = product(skeleton.mounts[0].T, rotation)
    poses[:, rotations[0]] = elementary.arctan2(own[:, 1, 0], own[:, 0, 0])
    poses[:, rotations[1]] = elementary.arcsin(np.clip(-own[:, 2, 0], -1.0, 1.0))
    poses[:, rotations[2]] = elementary.arctan2(own[:, 2, 1], own[:, 2, 2])
    return rotation


def _aligned(rest: Array, seen: Array, weights: Array) -> Array:
    """Return rotations (T, 3, 3) that best align points (P, 3) with (T, P, 3), about the means."""
    w = weights / weights.sum()
    a, b = rest - product(w, rest), seen - np.einsum('p,tpi->ti', w, seen)[:, None]
    u, _, vt = singular_values(np.einsum('tpi,p,pj->tij', b, w, a))
    u[:, :, 2] *= np.sign(determinant(product(u, vt)))[:, None]
    result: Array = product(u, vt)
    return result


def _smoothed(values: Array, sigma: float) -> Array:
    """Smooth values (T, n) over time with Gaussian weights; the end values are repeated."""
    reach = int(4.0 * sigma + 0.5)
    weights = elementary.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights /= weights.sum()
    padded = np.pad(values, ((reach, reach), (0, 0)), mode='edge')
    windows = np.lib.stride_tricks.sliding_window_view(padded, len(weights), axis=0)
    return np.asarray(np.einsum('tnw,w->tn', windows, weights))


def _twist(
    skeleton: Skeleton,
    s: int,
    turn: Array,
    place: Mapping[str, Array],
    next_end: str,
    fps: float | None,
) -> Array:
    """Return the third angle of a spherical joint, the twist, from the next segments.

    In a limb the twist follows from a bent hinge, or from the foot of a straight leg, or else from
    neighbouring frames. In the trunk the twist follows from the line of the shoulders.
    """
    if not next_end:
        line = _local(turn, place['right_shoulder'] - place['left_shoulder'])
        return np.asarray(elementary.arctan2(line[:, 1], line[:, 0]))
    side, _, joint = next_end.partition('_')
    middle_joint = f'{side}_{"knee" if joint == "ankle" else "elbow"}'
    hinge = next(i for i, t in enumerate(skeleton.dof_segments) if skeleton.parents[t] == s)
    sense = np.sign(skeleton.lower[hinge] + skeleton.upper[hinge])
    w = _local(turn, place[middle_joint] - place[next_end])
    said = sense * np.stack([-w[:, 1], w[:, 0]], axis=1)
    toe = f'{side}_toe'
    if joint == 'ankle' and toe in place:
        forward_of_foot = _local(turn, place[toe] - place[next_end])
        said += FOOT_WEIGHT * np.stack([forward_of_foot[:, 1], -forward_of_foot[:, 0]], axis=1)
    around = said if fps is None else _smoothed(said, AROUND_TIME * fps)
    said = said + NEIGHBOUR_WEIGHT * around + [ZERO_TWIST_WEIGHT, 0.0]
    twist: Array = elementary.arctan2(said[:, 1], said[:, 0])
    return twist


def _local(turn: Array, direction: Array) -> Array:
    """Unit vectors (T, 3) of directions, expressed in frames (T, 3, 3)."""
    norm = np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    result: Array = np.einsum('tij,ti->tj', turn, direction / norm)
    return result


def _turned(skeleton: Skeleton, dofs: Sequence[int], poses: Array, turn: Array) -> Array:
    for dof in dofs:
        axis = int(skeleton.dof_axes[dof])
        i, j = (axis + 1) % 3, (axis + 2) % 3
        cos, sin = elementary.cos(poses[:, dof])[:, None], elementary.sin(poses[:, dof])[:, None]
        new = turn.copy()
        new[:, :, i] = cos * turn[:, :, i] + sin * turn[:, :, j]
        new[:, :, j] = cos * turn[:, :, j] - sin * turn[:, :, i]
        turn = new
    return turn


def _within(poses: Array, skeleton: Skeleton) -> Array:
    """Bring the angles of poses into the limits by whole turns, then clip them."""
    poses = poses.copy()
    lower, upper = skeleton.lower, skeleton.upper
    for i in np.flatnonzero(skeleton.dof_is_rotation):
        if skeleton.dof_names[i] != 'root_z':
            middle = 0.5 * (lower[i] + upper[i])
            poses[:, i] -= 2 * np.pi * np.round((poses[:, i] - middle) / (2 * np.pi))
    result: Array = np.clip(poses, lower, upper)
    return result
