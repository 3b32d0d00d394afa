"""Forward/backward flips of limbs: interpretation trees, closed-form inverse kinematics (KJS 3).

A link of length l leads from a known joint P to a joint on the unit ray r. This joint is at

    s r,    s = r.P +- sqrt((r.P)^2 - |P|^2 + l^2).

Each choice of signs along a chain is a leaf of its interpretation tree. For several chains, the
leaves of their trees are combined. Every leaf has the image and the segment lengths of the given
pose, which is the first leaf. A branch is pruned if its ray misses the sphere, if a joint is behind
the camera, or if no joint angles within the limits reach it.

`distinct_poses` compares joint positions, because poses do not have unique angles: a rotation has
two triples of Euler angles, Rx(a) Ry(b) Rz(c) = Rx(a + pi) Ry(pi - b) Rz(c + pi), angles are
periodic, and the twist of a straight limb is invisible.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.core import grow_leaves, keep_distinct
from hmt_ros.flips.chain_links import ChainLinks, chain_links
from hmt_ros.inference.arrays import Array, Index


def enumerate_flips(
    body: Body, poses: ArrayLike, chains: Sequence[str] | str
) -> tuple[Array, Index]:
    """Enumerates the flips of chains: poses with the same image as the given poses.

    Args:
        body: body of the poses.
        poses: (N, d) poses in the camera frame. Flips move joints along their rays, so camera
            intrinsics are not needed.
        chains: name of a chain, or several names, whose flips are combined.

    Returns:
        Poses (M, d), grouped by given pose, and for each the index (M,) of its given pose. A given
        pose is the first of its group.

    Raises:
        KeyError: the body has no such chain.
        ValueError: the joints of a chain have no closed-form solution, or two chains share
            segments.

    Example:
        Four poses of an arm have one image: the upper arm and the forearm each lead towards the
        camera or away from it.

        >>> import numpy as np
        >>> from hmt_ros.body import Camera, load_body
        >>> body = load_body('human37')
        >>> pose = np.r_[0.0, 0.0, 4.0, body.prior_mean[3:]]
        >>> flips, parents = enumerate_flips(body, pose, 'left_arm')
        >>> wrist = body.joint_names.index('left_wrist')
        >>> camera = Camera(fx=600.0, fy=600.0, cx=319.5, cy=239.5, width=640, height=480)
        >>> pixels = camera.project(body.joint_positions(flips)[:, wrist])
        >>> len(flips), bool(np.ptp(pixels, axis=0).max() < 1e-6)
        (4, True)
    """
    names = [chains] if isinstance(chains, str) else list(chains)
    skeleton = body.skeleton
    q = np.array(poses, dtype=np.float64, ndmin=2, order='C')
    frames = forward(skeleton, q)
    links = [chain_links(skeleton, name) for name in names]
    segments = [s for chain in links for s in chain.segments.tolist()]
    if len(set(segments)) < len(segments):
        raise ValueError(f'chains {names} share segments, their trees can not be multiplied')
    trees = [_leaves(frames, q, chain) for chain in links]
    mask = np.ones(len(q), dtype=np.bool_)
    for _, valid in trees:
        mask = mask[..., None] & valid.reshape(len(q), *(1,) * (mask.ndim - 1), valid.shape[1])
    parents, *choices = np.nonzero(mask)
    result = q[parents]
    for chain, (angles, _), choice in zip(links, trees, choices, strict=True):
        result[:, chain.dofs] = angles[parents, choice]
    return result, parents


def _leaves(frames: Frames, poses: Array, chain: ChainLinks) -> tuple[Array, NDArray[np.bool_]]:
    """Angles (N, leaves, chain dofs) and validity (N, leaves); leaf 0 is the given pose."""
    lengths = chain.lengths[:, None, None]
    ends = frames.origins[chain.segments] - lengths * frames.columns[chain.segments, 2]
    count = 2 ** len(chain.lengths)
    angles = np.empty((len(poses), count, len(chain.dofs)))
    valid = np.zeros((len(poses), count), dtype=np.bool_)
    ends = np.ascontiguousarray(ends)
    grow_leaves(chain, frames.columns, frames.origins, poses, ends, 0.0, True, angles, valid)
    valid[:, 0] = True
    angles[:, 0] = poses[:, chain.dofs]
    return angles, valid


class Distinct(NamedTuple):
    """Poses that represent a set of poses.

    Attributes:
        kept: (K,) indices of the kept poses, ascending.
        owner: (N,) position in `kept` of the pose that represents each pose; -1 if none does,
            because the maximum number was reached.
    """

    kept: Index
    owner: Index


def distinct_poses(joints: ArrayLike, apart: float, most: int | None = None) -> Distinct:
    """Selects poses that differ from all earlier poses.

    The distance of two poses is the largest distance between corresponding joints. A pose nearer
    than `apart` to a kept pose is represented by the nearest kept pose. If poses are sorted best
    first, better poses represent worse poses.

    Args:
        joints: (N, J, 3) joint positions of the poses, m.
        apart: minimum distance between distinct poses, m.
        most: maximum number of kept poses; None: no maximum.

    Raises:
        ValueError: the joints do not have the shape (N, J, 3).
    """
    points = np.ascontiguousarray(joints, dtype=np.float64)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f'joints must have shape (N, J, 3), saw {points.shape}')
    flat = points.reshape(len(points), 3 * points.shape[1])
    kept, owner = (np.empty(len(flat), dtype=np.intp) for _ in range(2))
    most = len(flat) if most is None else int(most)
    count = keep_distinct(flat, float(apart), most, kept, owner)
    return Distinct(kept[:count], owner)
