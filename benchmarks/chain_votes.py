"""Which chain of the body is worth a jump: votes from the local uncertainty (KJS figure 5).

The vote of the paper reads the covariance alone. Another one counts what a jump brings: the leaves
of the chain's interpretation tree that are not known yet. `python -m benchmarks votes` compares
them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.flips.interpretation_tree import enumerate_flips
from hmt_ros.inference.arrays import Array

VOTES = ('trace', 'uniform', 'minima')

# Poses are different minima from this distance of a joint, m.
APART = 0.08
# Minima that a sample of a chain finds without a flip, on average over the chains: what is left to
# vote for where no flip is new.
WITHOUT_FLIP = 0.1


def chain_votes(
    body: Body,
    covariances: Array,
    chains: Sequence[str],
    vote: str = 'trace',
    poses: Array | None = None,
    known: Array | None = None,
) -> Array:
    """Probabilities (K, C) with which each mode's chains are chosen.

    'trace': the trace of the block of the covariance that belongs to the rotations of the chain,
    which equals the sum over the eigenvectors of eigenvalue times squared length inside the chain;
    'uniform': all alike; 'minima': the share of the leaves of the chain's interpretation tree that
    are minima which are not known yet, plus a little by its trace, for those that no flip reaches.

    Args:
        body: with the chains.
        covariances: (K, d, d) of the modes.
        chains: names.
        vote: one of `VOTES`.
        poses: (K, d) of the modes, which 'minima' reads.
        known: (M, d) minima that are not new to 'minima'; None: the pose of each mode alone.

    Raises:
        ValueError: an unknown vote, or one that needs poses without them.
    """
    if vote not in VOTES:
        raise ValueError(f'vote must be one of {VOTES}, saw {vote!r}')
    result = np.ones((len(covariances), len(chains)))
    if vote != 'uniform':
        for i, chain in enumerate(chains):
            own = body.skeleton.chain_dofs[chain]
            result[:, i] = np.einsum('kii->k', covariances[:, own[:, None], own])
    if vote == 'minima':
        if poses is None:
            raise ValueError(f'vote {vote!r} needs the poses of the modes')
        result *= WITHOUT_FLIP / result.mean(1, keepdims=True)
        result += np.stack([shares_of_new_minima(body, poses, c, known) for c in chains], axis=1)
    shares: Array = result / result.sum(1, keepdims=True)
    return shares


def shares_of_new_minima(body: Body, poses: Array, chain: str, known: Array | None = None) -> Array:
    """Share (K,) of the leaves of a chain's interpretation tree that are new minima.

    Leaves are within the limits; the pose itself is one of them. A leaf is new when some joint,
    seen from the pelvis, is further than `APART` from where it is in every pose that is known. The
    share, not the number: every leaf costs an optimisation.

    Args:
        body: with the chain.
        poses: (K, d).
        chain: name.
        known: (M, d); None: none but the pose itself.
    """
    leaves, parents = enumerate_flips(body, poses, chain)
    joints, before = (body.relative_joints(x) for x in (leaves, poses))
    new = np.linalg.norm(joints - before[parents], axis=2).max(1) > APART
    if known is not None and len(known):
        gaps = joints[:, None] - body.relative_joints(known)[None]
        new &= (np.linalg.norm(gaps, axis=3).max(2) > APART).all(1)
    count = np.bincount(parents, weights=new, minlength=len(poses))
    share: Array = count / np.bincount(parents, minlength=len(poses))
    return share
