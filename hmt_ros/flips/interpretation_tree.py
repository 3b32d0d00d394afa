"""Forwards/backwards flips of limbs: interpretation trees, closed-form inverse kinematics (KJS 3).

For a link from a known joint P, of length l, to a joint seen along the unit ray r, the joint is at

    s r,    s = r.P +- sqrt((r.P)^2 - |P|^2 + l^2).

All choices of sign along a chain are the leaves of its interpretation tree; a branching body takes
the product of the trees of its chains. Every leaf has the image and the segment lengths of the
given pose, which is itself the first leaf. Branches whose ray misses the sphere, that put a joint
behind the camera, or that no joint angles within the limits reach, are pruned.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.flips.tree_growth import ChainLinks, chain_links, grow_leaves
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


def rehang_chain(
    body: Body,
    poses: ArrayLike,
    new_poses: ArrayLike,
    chain: str,
    *,
    image_of: str | None = None,
    slack: float = 0.1,
) -> tuple[Array, Index]:
    """Poses whose chain hangs on another trunk and still has the image that it had.

    When a trunk turns or flips, its limbs start elsewhere. Their joints are put back onto the rays
    through their images, in all ways that lengths and limits allow. `image_of` puts them onto the
    image of another chain instead, such as a left leg onto that of the right leg.

    Args:
        body: the body.
        poses: (N, d) that have the image.
        new_poses: (N, d) with the other trunk.
        chain: name of the chain.
        image_of: name of the chain whose image is taken; None selects the chain itself.
        slack: a ray that misses its sphere by less than this touches it, m.

    Returns:
        poses (M, d), equal to the new ones outside the chain, and the index (M,) of each.

    Raises:
        KeyError, ValueError: as `enumerate_flips`.
    """
    skeleton = body.skeleton
    links = chain_links(skeleton, chain)
    new = np.array(new_poses, dtype=np.float64, ndmin=2, order='C')
    seen = forward(skeleton, np.array(poses, dtype=np.float64, ndmin=2))
    ends = links if image_of is None else chain_links(skeleton, image_of)
    if len(ends.lengths) != len(links.lengths):
        raise ValueError(f'chains {chain} and {image_of} differ in their number of segments')
    angles, valid = _grown(forward(skeleton, new), new, links, _ends(seen, ends), slack)
    parents, choice = np.nonzero(valid)
    result = new[parents]
    result[:, links.dofs] = angles[parents, choice]
    return result, parents


def flip_counts(body: Body, poses: ArrayLike, chain: str) -> Index:
    """Number of leaves (N,) that the tree of one chain has at each pose."""
    q = np.array(poses, dtype=np.float64, ndmin=2, order='C')
    _, valid = _leaves(forward(body.skeleton, q), q, chain_links(body.skeleton, chain))
    counts: Index = valid.sum(1)
    return counts


def _leaves(frames: Frames, poses: Array, chain: ChainLinks) -> tuple[Array, NDArray[np.bool_]]:
    """Angles (N, leaves, chain dofs) and validity (N, leaves); leaf 0 is the given pose."""
    angles, valid = _grown(frames, poses, chain, _ends(frames, chain), 0.0, given_stays=True)
    valid[:, 0] = True
    angles[:, 0] = poses[:, chain.dofs]
    return angles, valid


def _ends(frames: Frames, chain: ChainLinks) -> Array:
    """Ends of the links of a chain, (K, 3, N)."""
    lengths = chain.lengths[:, None, None]
    ends: Array = frames.origins[chain.segments] - lengths * frames.columns[chain.segments, 2]
    return ends


def _grown(
    frames: Frames,
    poses: Array,
    chain: ChainLinks,
    targets: Array,
    slack: float,
    *,
    given_stays: bool = False,
) -> tuple[Array, NDArray[np.bool_]]:
    """Leaves of the trees of one chain: angles (N, 2^K, D), and where there is one (N, 2^K).

    The arguments are those of `grow_leaves`.
    """
    count = 2 ** len(chain.lengths)
    angles = np.empty((len(poses), count, len(chain.dofs)))
    valid = np.zeros((len(poses), count), dtype=np.bool_)
    grow_leaves(
        chain, frames.columns, frames.origins, poses, targets, float(slack), given_stays, angles,
        valid,
    )  # fmt: skip
    return angles, valid
