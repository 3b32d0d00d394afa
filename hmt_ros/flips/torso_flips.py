"""Flips of the torso: the pelvis and the trunk leaning or turning the other way in depth (KJS 3).

The line of the hips may turn towards or away from the camera, the neck may lie before or behind the
start of the trunk, and the line of the shoulders may turn either way: three binary choices, with
nearly the same image. The torso is not a chain of links that each end in one joint, so its flips
change the image of hips, neck and shoulders a little; `rehang_chain` then puts the limbs back onto
their rays.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import ROOT_AXES, rotations_of
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference.arrays import Array, Index

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
    (root, axes), trunk = rotations_of(skeleton, 0), _trunk_dofs(skeleton)
    if axes != ROOT_AXES or trunk is None or not set(JOINTS) <= set(skeleton.joint_names):
        return np.empty((0, body.dimension)), np.empty(0, dtype=np.intp)
    frames = forward(skeleton, q)
    which = skeleton.joint_index(JOINTS)
    torso = frames.points(skeleton.joint_segments[which], skeleton.joint_offsets[which])
    pelvis, neck, left_hip, right_hip, left_shoulder, right_shoulder = torso
    hips, shoulders = right_hip - left_hip, right_shoulder - left_shoulder
    # All F flips of all poses at once: a batch of N F, pose by pose.
    turn_hips, lean, turn_shoulders = np.array(_flips(len(trunk))).T
    wanted_hips = _chosen(turn_hips, _turned(hips, pelvis), hips)
    wanted_shoulders = _chosen(turn_shoulders, _turned(shoulders, neck), shoulders)
    parents = np.repeat(np.arange(len(q)), len(lean))
    result = q[parents]
    fits = np.ones(len(result), dtype=np.bool_)
    turned = np.flatnonzero(np.tile(turn_hips, len(q)))
    new = result[turned]
    z = frames.columns[0, 2][:, parents[turned]]
    fits[turned] &= _turn_root(skeleton, z, root, wanted_hips[:, turned], new)
    result[turned] = new
    change = np.abs(wanted_hips[2] - hips[2, parents])
    change = np.maximum(change, np.abs(wanted_shoulders[2] - shoulders[2, parents]))
    if len(trunk) >= 2:
        segment = skeleton.segment_names.index('trunk')
        before = frames.origins[segment][:, parents]
        start = forward(skeleton, result).origins[segment]
        leans = np.tile(lean, len(q))
        wanted_neck, meets = _neck(before, start, neck[:, parents], leans)
        fits &= meets | ~leans
        change = np.maximum(change, np.abs(wanted_neck[2] - neck[2, parents]))
        fits &= _turn_trunk(skeleton, trunk, wanted_neck - start, wanted_shoulders, result)
    fits &= change > SIGNIFICANT
    return result[fits], parents[fits]


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


def _chosen(flips: NDArray[np.bool_], flipped: Array, given: Array) -> Array:
    """Vectors (3, N F), pose by pose: those of (3, N) that some of the flips (F,) change."""
    result: Array = np.where(flips, flipped[:, :, None], given[:, :, None]).reshape(3, -1)
    return result


def _turned(line: Array, at: Array) -> Array:
    """A line (3, N) with its component along the ray to a point reversed."""
    ray = at / np.sqrt((at * at).sum(0))
    result: Array = line - 2.0 * (line * ray).sum(0) * ray
    return result


def _neck(
    before: Array, start: Array, neck: Array, lean: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """Where the neck (3, N) goes on its ray when the trunk starts elsewhere; whether it gets there.

    Args:
        before: (3, N) where the trunk started.
        start: (3, N) where it starts now.
        neck: (3, N) where the neck was.
        lean: (N,) whether it goes to the other side of the trunk's start.
    """
    distance = np.sqrt((neck * neck).sum(0))
    ray = neck / distance
    middle = (ray * start).sum(0)
    reach = ((neck - before) ** 2).sum(0) - (start * start).sum(0) + middle**2
    side = np.where((distance < (ray * before).sum(0)) != lean, -1.0, 1.0)
    return (middle + side * np.sqrt(np.maximum(reach, 0.0))) * ray, reach > 0.0


def _turn_root(
    skeleton: Skeleton, z: Array, dofs: list[int], hips: Array, poses: Array
) -> NDArray[np.bool_]:
    """Turns the root: its x axis follows the hips, its z axis stays as near to z as it can."""
    x = hips / np.sqrt((hips * hips).sum(0))
    z = z - (z * x).sum(0) * x
    z = z / np.maximum(np.sqrt((z * z).sum(0)), 1e-9)
    y = np.cross(z, x, axis=0)
    r = np.einsum('ji,jkn->ikn', skeleton.mounts[0], np.stack([x, y, z], axis=1))
    b = -np.arcsin(np.clip(r[2, 0], -1.0, 1.0))
    a, c = np.arctan2(r[1, 0], r[0, 0]), np.arctan2(r[2, 1], r[2, 2])
    return _set_within_limits(skeleton, dofs, (a, b, c), poses)


def _turn_trunk(
    skeleton: Skeleton, dofs: list[int], up: Array, shoulders: Array, poses: Array
) -> NDArray[np.bool_]:
    """Turns the trunk so that it points up as wanted and its x axis follows the shoulders."""
    trunk = skeleton.segment_names.index('trunk')
    frames = forward(skeleton, poses)
    base = np.einsum('ixn,ij->jxn', frames.columns[skeleton.parents[trunk]], skeleton.mounts[trunk])
    # The trunk runs along its negative z axis: (sin b, -sin a cos b, cos a cos b) = base^T (-up).
    v = -(base * (up / np.sqrt((up * up).sum(0)))).sum(1)
    b = np.arcsin(np.clip(v[0], -1.0, 1.0))
    a = np.arctan2(-v[1], v[2])
    if len(dofs) == 2:
        return _set_within_limits(skeleton, dofs, (a, b), poses)
    tilted = poses.copy()
    tilted[:, dofs[0]], tilted[:, dofs[1]], tilted[:, dofs[2]] = a, b, 0.0
    columns = forward(skeleton, tilted).columns[trunk]
    c = np.arctan2((columns[1] * shoulders).sum(0), (columns[0] * shoulders).sum(0))
    return _set_within_limits(skeleton, dofs, (a, b, c), poses)


def _set_within_limits(
    skeleton: Skeleton, dofs: list[int], angles: tuple[Array, ...], poses: Array
) -> NDArray[np.bool_]:
    """Writes angles into poses (N, d), nearest to the old ones modulo a turn; where they fit."""
    fits = np.ones(len(poses), dtype=bool)
    for j, angle in zip(dofs, angles, strict=True):
        near = angle + 2 * np.pi * np.round((poses[:, j] - angle) / (2 * np.pi))
        fits &= (near >= skeleton.lower[j]) & (near <= skeleton.upper[j])
        poses[:, j] = near
    return fits
