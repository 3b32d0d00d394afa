"""Flips of the torso: pelvis and trunk lean or turn the other way in depth (KJS 3).

The line of the hips can turn towards or away from the camera, the neck can be in front of or behind
the start of the trunk, and the line of the shoulders can turn either way: three binary choices with
nearly the same image. The torso is not a chain of links with one joint at each end, so its flips
change the image of hips, neck and shoulders a little; the limbs are then moved back to their rays.
"""

from __future__ import annotations

import itertools
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import placing_of
from hmt_ros.body.mirror import ROOT_AXES, rotations_of
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.core import fill_torso_flips
from hmt_ros.inference.arrays import Array, Index, Mask

JOINTS = ('pelvis', 'neck', 'left_hip', 'right_hip', 'left_shoulder', 'right_shoulder')


def flip_torso(body: Body, poses: ArrayLike) -> tuple[Array, Index]:
    """Flips the torso in depth: returns up to seven flips of each pose.

    Args:
        body: body with the joints of a torso, a root that rotates about z, y and x, and a segment
            'trunk' that rotates about x, y and, if it can twist, z. Other bodies have no flips.
        poses: (N, d) poses.

    Returns:
        Poses (M, d) within the limits, with unchanged angles of the limbs, and for each the index
        (M,) of its given pose.
    """
    skeleton = body.skeleton
    q = np.array(poses, dtype=np.float64, ndmin=2, order='C')
    torso = _torso_of(skeleton)
    if torso is None:
        return np.empty((0, body.dimension)), np.empty(0, dtype=np.intp)
    most = len(q) * len(torso.flips)
    result, parents = np.empty((most, body.dimension)), np.empty(most, dtype=np.intp)
    found = fill_torso_flips(placing_of(skeleton), torso, q, result, parents)
    return result[:found], parents[:found]


class _Torso(NamedTuple):
    """Torso, as input for the compiled functions.

    Attributes:
        root, trunk: degrees of freedom that rotate the root (3,) and the trunk (0, 2 or 3 of them).
        segment: index of the trunk's segment.
        joint_segments, joint_offsets: segments (6,) and offsets (6, 3) of the `JOINTS`.
        lower, upper: (d,) limits of the pose.
        flips: (F, 3) whether each flip turns the hips, leans the torso and turns the shoulders.
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
    """Torso of a skeleton; None if it has no torso that can flip."""
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
    """All possible flips: whether the hips turn, the torso leans and the shoulders turn."""
    return [
        (turn_hips, lean, turn_shoulders)
        for turn_hips, lean, turn_shoulders in itertools.product((False, True), repeat=3)
        if (turn_hips or lean or turn_shoulders)
        # If the trunk cannot twist, the shoulders turn with the hips.
        and (trunk_dofs >= 3 or turn_shoulders == turn_hips)
        and (trunk_dofs >= 2 or not lean)
    ]


def _trunk_dofs(skeleton: Skeleton) -> list[int] | None:
    """Rotations of the trunk if their axes are xyz, xy or none; otherwise None."""
    if 'trunk' not in skeleton.segment_names:
        return None
    own, axes = rotations_of(skeleton, skeleton.segment_names.index('trunk'))
    return own if axes in ('', 'xy', 'xyz') else None
