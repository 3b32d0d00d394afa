"""Flips of the torso: the pelvis and the trunk leaning or turning the other way in depth (KJS 3).

The line of the hips may turn towards or away from the camera, the neck may lie before or behind the
start of the trunk, and the line of the shoulders may turn either way: three binary choices, with
nearly the same image. The torso is not a chain of links that each end in one joint, so its flips
change the image of hips, neck and shoulders a little; the limbs are then put back onto their rays.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import place_pose, place_segment, placing_of
from hmt_ros.body.mirror import ROOT_AXES, rotations_of
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference.arrays import Array, Index, Mask

JOINTS = ('pelvis', 'neck', 'left_hip', 'right_hip', 'left_shoulder', 'right_shoulder')
SIGNIFICANT = 0.04  # m; a flip changes the depth of some joint of the torso by more


def flip_torso(body: Body, poses: ArrayLike) -> tuple[Array, Index]:
    """Poses whose torso is flipped in depth, up to seven for each given one.

    Args:
        body: body with the joints of a torso, a root that turns about z, y and x, and a segment
            'trunk' that turns about x, y and, if it can twist, z. Others have no such flips.
        poses: (N, d).

    Returns:
        poses (M, d) within the limits, with the given angles of the limbs, and the index (M,) of
        the pose that each comes from.
    """
    skeleton = body.skeleton
    q = np.array(poses, dtype=np.float64, ndmin=2)
    torso = _torso_of(skeleton)
    if torso is None:
        return np.empty((0, body.dimension)), np.empty(0, dtype=np.intp)
    most = len(q) * len(torso.flips)
    result, parents = np.empty((most, body.dimension)), np.empty(most, dtype=np.intp)
    found = _fill_flips(placing_of(skeleton), torso, q, result, parents)
    return result[:found], parents[:found]


class _Torso(NamedTuple):
    """The torso as compiled code reads it.

    Attributes:
        root, trunk: (3,), (0, 2 or 3) degrees of freedom that turn the root and the trunk.
        segment: the trunk.
        joint_segments, joint_offsets: (6,), (6, 3) of the `JOINTS`.
        lower, upper: (d,) limits.
        flips: (F, 3) whether the hips turn, the torso leans and the shoulders turn.
    """

    root: NDArray[np.int64]
    trunk: NDArray[np.int64]
    segment: int
    joint_segments: NDArray[np.int64]
    joint_offsets: Array
    lower: Array
    upper: Array
    flips: Mask


@lru_cache(maxsize=16)
def _torso_of(skeleton: Skeleton) -> _Torso | None:
    """The torso of a skeleton; None: it has none that can flip."""
    (root, axes), trunk = rotations_of(skeleton, 0), _trunk_dofs(skeleton)
    if axes != ROOT_AXES or trunk is None or not set(JOINTS) <= set(skeleton.joint_names):
        return None
    which = skeleton.joint_index(JOINTS)
    return _Torso(
        np.array(root, dtype=np.int64),
        np.array(trunk, dtype=np.int64),
        skeleton.segment_names.index('trunk'),
        np.asarray(skeleton.joint_segments[which], dtype=np.int64),
        np.asarray(skeleton.joint_offsets[which], dtype=np.float64),
        np.asarray(skeleton.lower, dtype=np.float64),
        np.asarray(skeleton.upper, dtype=np.float64),
        np.array(_flips(len(trunk)), dtype=np.bool_).reshape(-1, 3),
    )


def _flips(trunk_dofs: int) -> list[tuple[bool, bool, bool]]:
    """Whether the hips turn, the torso leans and the shoulders turn, in all ways there are."""
    return [
        (turn_hips, lean, turn_shoulders)
        for turn_hips, lean, turn_shoulders in itertools.product((False, True), repeat=3)
        if (turn_hips or lean or turn_shoulders)
        # Without a twist the shoulders turn with the hips.
        and (trunk_dofs >= 3 or turn_shoulders == turn_hips)
        and (trunk_dofs >= 2 or not lean)
    ]


def _trunk_dofs(skeleton: Skeleton) -> list[int] | None:
    """The rotations of the trunk, if they are about x, y and z, or x and y, or none."""
    if 'trunk' not in skeleton.segment_names:
        return None
    own, axes = rotations_of(skeleton, skeleton.segment_names.index('trunk'))
    return own if axes in ('', 'xy', 'xyz') else None


@njit(cache=True, nogil=True, error_model='numpy')
def _fill_flips(tree, torso, poses, result, parents):  # type: ignore[no-untyped-def]
    """Fills the flips (M, d) of poses (N, d) and where each comes from (M,); returns M."""
    segments, d, segment = len(tree.parents), poses.shape[1], torso.segment
    columns, origins = np.empty((segments, 3, 3)), np.empty((segments, 3))
    axes, dof_origins = np.empty((d, 3)), np.empty((d, 3))
    joints, before, z = np.empty((6, 3)), np.empty(3), np.empty(3)
    count = 0
    for n in range(len(poses)):
        place_pose(tree, poses[n], columns, origins, axes, dof_origins)
        for j in range(6):
            s = torso.joint_segments[j]
            for k in range(3):
                joints[j, k] = origins[s, k]
                for i in range(3):
                    joints[j, k] += columns[s, i, k] * torso.joint_offsets[j, i]
        pelvis, neck = joints[0], joints[1]
        hips, shoulders = joints[3] - joints[2], joints[5] - joints[4]
        before[:], z[:] = origins[segment], columns[0, 2]
        for f in range(len(torso.flips)):
            turn_hips, lean, turn_shoulders = torso.flips[f]
            pose = result[count]
            pose[:] = poses[n]
            wanted_hips = _turned(hips, pelvis) if turn_hips else hips
            wanted_shoulders = _turned(shoulders, neck) if turn_shoulders else shoulders
            if turn_hips and not _turn_root(tree, torso, z, wanted_hips, pose):
                continue
            change = max(abs(wanted_hips[2] - hips[2]), abs(wanted_shoulders[2] - shoulders[2]))
            if len(torso.trunk) > 0:
                # The parents of a segment come before it.
                for s in range(segment + 1):
                    place_segment(tree, s, pose, columns, origins, axes, dof_origins)
                wanted_neck, meets = _neck(before, origins[segment], neck, lean)
                if lean and not meets:
                    continue
                change = max(change, abs(wanted_neck[2] - neck[2]))
                up = wanted_neck - origins[segment]
                if not _turn_trunk(
                    tree, torso, up, wanted_shoulders, pose, columns, origins, axes, dof_origins
                ):
                    continue
            if change > SIGNIFICANT:
                parents[count] = n
                count += 1
    return count


@njit(cache=True, nogil=True, inline='always')
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True, nogil=True)
def _turned(line, at):  # type: ignore[no-untyped-def]
    """A line (3,) with its component along the ray to a point reversed."""
    ray = at / np.sqrt(_dot(at, at))
    return line - 2.0 * _dot(line, ray) * ray


@njit(cache=True, nogil=True)
def _neck(before, start, neck, lean):  # type: ignore[no-untyped-def]
    """Where the neck (3,) goes on its ray when the trunk starts elsewhere; whether it gets there.

    Args:
        before, start: (3,) where the trunk started, and where it starts now.
        neck: (3,) where the neck was.
        lean: whether it goes to the other side of the trunk's start.
    """
    distance = np.sqrt(_dot(neck, neck))
    ray, gap = neck / distance, neck - before
    middle = _dot(ray, start)
    reach = _dot(gap, gap) - _dot(start, start) + middle**2
    side = -1.0 if (distance < _dot(ray, before)) != lean else 1.0
    return (middle + side * np.sqrt(max(reach, 0.0))) * ray, reach > 0.0


@njit(cache=True, nogil=True, error_model='numpy')
def _turn_root(tree, torso, z, hips, pose):  # type: ignore[no-untyped-def]
    """Turns the root of a pose (d,): its x axis follows the hips, its z axis stays near z.

    Returns whether it is within the limits.
    """
    x = hips / np.sqrt(_dot(hips, hips))
    z = z - _dot(z, x) * x
    z = z / max(np.sqrt(_dot(z, z)), 1e-9)
    y = np.array([z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]])
    mount = tree.mounts[0]
    # R = mount' [x y z]; its elements that tell the angles about z, y and x.
    xx, yx, zx = _dot(mount[:, 0], x), _dot(mount[:, 1], x), _dot(mount[:, 2], x)
    zy, zz = _dot(mount[:, 2], y), _dot(mount[:, 2], z)
    return (
        _set(torso, torso.root[0], np.arctan2(yx, xx), pose)
        & _set(torso, torso.root[1], -np.arcsin(min(max(zx, -1.0), 1.0)), pose)
        & _set(torso, torso.root[2], np.arctan2(zy, zz), pose)
    )


@njit(cache=True, nogil=True, error_model='numpy')
def _turn_trunk(tree, torso, up, shoulders, pose, columns, origins, axes, dof_origins):  # type: ignore[no-untyped-def]
    """Turns the trunk of a placed pose (d,) up as wanted, its x axis along the shoulders.

    Returns whether it is within the limits.
    """
    segment, own = torso.segment, torso.trunk
    above, mount = columns[tree.parents[segment]], tree.mounts[segment]
    # The trunk runs along its negative z axis: (sin b, -sin a cos b, cos a cos b) = base^T (-up).
    direction, v = up / np.sqrt(_dot(up, up)), np.empty(3)
    for j in range(3):
        v[j] = 0.0
        for i in range(3):
            v[j] -= mount[i, j] * _dot(above[i], direction)
    b = np.arcsin(min(max(v[0], -1.0), 1.0))
    a = np.arctan2(-v[1], v[2])
    if len(own) == 2:
        return _set(torso, own[0], a, pose) & _set(torso, own[1], b, pose)
    twist = pose[own[2]]
    fits = _set(torso, own[0], a, pose) & _set(torso, own[1], b, pose)
    pose[own[2]] = 0.0
    place_segment(tree, segment, pose, columns, origins, axes, dof_origins)
    pose[own[2]] = twist
    axis = columns[segment]
    c = np.arctan2(_dot(axis[1], shoulders), _dot(axis[0], shoulders))
    return fits & _set(torso, own[2], c, pose)


@njit(cache=True, nogil=True, inline='always')
def _set(torso, j, angle, pose):  # type: ignore[no-untyped-def]
    """Sets an angle of a pose (d,), nearest to the old one modulo a turn; whether it may be."""
    near = angle + 2.0 * np.pi * np.rint((pose[j] - angle) / (2.0 * np.pi))
    pose[j] = near
    return (near >= torso.lower[j]) & (near <= torso.upper[j])
