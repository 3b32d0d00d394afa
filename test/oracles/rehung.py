"""Limbs moved to another trunk that keep their image or take that of another limb."""

from __future__ import annotations

import numpy as np

from hmt_ros.body.kinematics import forward
from hmt_ros.core import grow_leaves
from hmt_ros.flips.chain_links import chain_links


def rehang_chain(body, poses, new_poses, chain, *, image_of=None, slack=0.1):
    """Poses whose chain is moved to another trunk and still has the same image.

    Its joints are placed on the rays through their images, in all ways that lengths and limits
    allow.

    Args:
        body: the body.
        poses: poses (N, d) with the image.
        new_poses: poses (N, d) with the other trunk.
        chain: name of the chain.
        image_of: name of the chain whose image is used; None: the chain itself.
        slack: a ray that misses its sphere by less than this touches it, m.

    Returns:
        poses (M, d), equal to the new ones outside the chain, and the index (M,) of each.
    """
    skeleton = body.skeleton
    links = chain_links(skeleton, chain)
    ends = links if image_of is None else chain_links(skeleton, image_of)
    new = np.array(new_poses, dtype=np.float64, ndmin=2, order='C')
    seen = forward(skeleton, np.array(poses, dtype=np.float64, ndmin=2))
    targets = seen.origins[ends.segments]
    targets = targets - ends.lengths[:, None, None] * seen.columns[ends.segments, 2]
    frames, leaves = forward(skeleton, new), 2 ** len(links.lengths)
    angles = np.empty((len(new), leaves, len(links.dofs)))
    valid = np.zeros((len(new), leaves), dtype=np.bool_)
    grow_leaves(
        links, frames.columns, frames.origins, new, targets, float(slack), False, angles, valid
    )
    parents, choice = np.nonzero(valid)
    result = new[parents]
    result[:, links.dofs] = angles[parents, choice]
    return result, parents
