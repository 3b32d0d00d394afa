"""Votes against eigenvectors and the leaves of the trees."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.chain_votes import VOTES, chain_votes, shares_of_new_minima
from hmt_ros.flips.interpretation_tree import enumerate_flips, flip_counts

CHAINS = ('left_arm', 'right_arm', 'left_leg', 'right_leg', 'neck')


def test_votes_by_trace_are_those_of_the_eigenvectors(human32, modes):
    """Sum over eigenvectors of eigenvalue times squared length inside the chain."""
    _, covariances = modes
    votes = chain_votes(human32, covariances, CHAINS)
    for k in range(2):
        values, vectors = np.linalg.eigh(covariances[k])
        shares = []
        for chain in CHAINS:
            inside = vectors[human32.skeleton.chain_dofs[chain]]
            shares.append((values * (inside**2).sum(0)).sum())
        assert np.allclose(votes[k], np.array(shares) / np.sum(shares), rtol=1e-10)


def test_uniform_votes(human32, modes):
    votes = chain_votes(human32, modes[1], CHAINS[:4], 'uniform')
    assert np.array_equal(votes, np.full((2, 4), 0.25))


def test_an_uncertain_chain_gets_the_votes(human32):
    covariance = 1e-4 * np.eye(32)[None]
    own = human32.skeleton.chain_dofs['right_arm']
    covariance[:, own, own] = 1e-2
    votes = chain_votes(human32, covariance, CHAINS, 'trace')
    share = 100 * 6 / (100 * 6 + 3 * 6 + 2)
    assert votes[0, CHAINS.index('right_arm')] == pytest.approx(share, rel=1e-12)
    assert votes.sum() == pytest.approx(1.0, rel=1e-12)


def test_votes_are_probabilities(human32, motion):
    covariances = np.tile(1e-2 * np.eye(32), (len(motion), 1, 1))
    for vote in VOTES:
        votes = chain_votes(human32, covariances, CHAINS, vote, motion, motion)
        assert votes.shape == (12, 5)
        assert (votes > 0).all()
        assert np.allclose(votes.sum(1), 1.0, rtol=1e-12)


def test_shares_of_new_minima(human32, motion):
    """Leaves that are not the pose; none is left when all leaves are known."""
    for chain in CHAINS[:4]:
        leaves, parents = enumerate_flips(human32, motion, chain)
        joints = human32.joint_positions(leaves)
        joints -= joints[:, :1]
        first = np.array([joints[parents == k][0] for k in range(len(motion))])
        apart = np.linalg.norm(joints - first[parents], axis=2).max(1) > 0.08
        counts = flip_counts(human32, motion, chain)
        wanted = [apart[parents == k].sum() / counts[k] for k in range(len(motion))]
        assert np.allclose(shares_of_new_minima(human32, motion, chain), wanted)
        assert not shares_of_new_minima(human32, motion, chain, leaves).any()
        if apart.any():
            some = leaves[apart][:1]
            assert shares_of_new_minima(human32, motion, chain, some).sum() < sum(wanted)


def test_known_minima_get_no_votes(human32, motion):
    covariance = 1e-2 * np.eye(32)[None]
    shares = [[shares_of_new_minima(human32, p[None], c)[0] for c in CHAINS] for p in motion]
    k, i = np.unravel_index(np.argmax(shares), np.shape(shares))
    pose = motion[k : k + 1]
    leaves, _ = enumerate_flips(human32, pose, CHAINS[i])
    before = chain_votes(human32, covariance, CHAINS, 'minima', pose)[0]
    after = chain_votes(human32, covariance, CHAINS, 'minima', pose, leaves)[0]
    assert before[i] == max(before)
    assert after[i] < 0.5 * before[i]


def test_what_is_unknown_is_refused(human32, modes):
    with pytest.raises(ValueError, match=r"vote must be one of .*trace.*saw 'loud'"):
        chain_votes(human32, modes[1], CHAINS, 'loud')
    with pytest.raises(KeyError, match='tail'):
        chain_votes(human32, modes[1], ('tail',))
    with pytest.raises(ValueError, match="vote 'minima' needs the poses"):
        chain_votes(human32, modes[1], CHAINS, 'minima')
