"""Forwards/backwards flips of limbs: interpretation trees, closed-form inverse kinematics (KJS 3).

For a link from a known joint P, of length l, to a joint seen along the unit ray r, the joint is at

    s r,    s = r.P +- sqrt((r.P)^2 - |P|^2 + l^2).

All choices of sign along a chain are the leaves of its interpretation tree; a branching body takes
the product of the trees of its chains. Every leaf has the image and the segment lengths of the
given pose, which is itself the first leaf. Branches whose ray misses the sphere, that put a joint
behind the camera, or that no joint angles within the limits reach, are pruned.

`distinct_poses` compares poses by their joint positions, not by their angles: a rotation has two
triples of Euler angles, Rx(a) Ry(b) Rz(c) = Rx(a + pi) Ry(pi - b) Rz(c + pi), every angle has its
turns of 2 pi, and the twist of a straight limb moves nothing that is seen.
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
    """All poses with the image of the given ones that flips of some chains reach.

    Args:
        body: the body.
        poses: (N, d) in the frame of the camera. Flips move joints along their rays, so that the
            lens of the camera does not matter.
        chains: name of a chain, or several names: then the product of their trees is taken.

    Returns:
        poses (M, d), grouped by the given pose, which is the first of its own leaves, and the
        index (M,) of that pose.

    Raises:
        KeyError: the body does not have a chain.
        ValueError: the joints of a chain have no closed form, or two chains share segments.
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
    """Poses that represent all of a set.

    Attributes:
        kept: (K,) indices, in the order of the poses.
        owner: (N,) position in `kept` of the representative of each pose; -1 where the maximum
            number was reached before.
    """

    kept: Index
    owner: Index


def distinct_poses(joints: ArrayLike, apart: float, most: int | None = None) -> Distinct:
    """Poses that differ from every earlier one.

    The distance of two poses is that of the joint that is furthest apart. A pose that is nearer
    than `apart` to one that is kept is represented by the nearest of these. So the first, best
    poses represent later ones.

    Args:
        joints: (N, J, 3) joint positions of the poses, m.
        apart: distance from which on two poses are distinct, m.
        most: maximum number of poses that are kept; None keeps all that are distinct.

    Raises:
        ValueError: joints of another shape.
    """
    points = np.ascontiguousarray(joints, dtype=np.float64)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f'joints must have shape (N, J, 3), saw {points.shape}')
    flat = points.reshape(len(points), 3 * points.shape[1])
    kept, owner = (np.empty(len(flat), dtype=np.intp) for _ in range(2))
    most = len(flat) if most is None else int(most)
    count = keep_distinct(flat, float(apart), most, kept, owner)
    return Distinct(kept[:count], owner)
