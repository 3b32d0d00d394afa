"""Products of chain alternatives against full enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.special import logsumexp

from hmt_ros.flips.best_combinations import Alternatives, best_combinations, distinct_alternatives

CHAINS = ('left_arm', 'right_arm', 'left_leg')
TEMPERATURE = 0.3


def group_of(body, modes, sizes, seed):
    """Modes (G, d), their log weights, alternatives of three chains and what they change."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(modes, body.dimension))
    alternatives = [
        Alternatives(
            chain,
            rng.normal(size=(size, len(body.skeleton.chain_dofs[chain]))),
            rng.exponential(1.5, (modes, size)),
        )
        for chain, size in zip(CHAINS, sizes)
    ]
    changes = [rng.normal(0, 4.0, size) for size in sizes]
    return poses, np.log(rng.dirichlet(np.ones(modes))), alternatives, changes


def enumerated(log_weights, alternatives, changes, base):
    """Every combination: its cost by its best mode, that mode, energy, and log prior of them."""
    result = []
    for pick in itertools.product(*(range(len(a.angles)) for a in alternatives)):
        priors = np.array(
            [
                w - sum(a.penalties[g, i] for a, i in zip(alternatives, pick))
                for g, w in enumerate(log_weights)
            ]
        )
        change = sum(c[i] for c, i in zip(changes, pick))
        best = int(np.argmax(priors))
        cost = TEMPERATURE * change - priors[best]
        result.append((cost, pick, best, base + change, float(logsumexp(priors)), priors[best]))
    return sorted(result)


def found_picks(body, combinations, alternatives):
    """Which alternatives the poses carry."""
    columns = []
    for a in alternatives:
        own = combinations.poses[:, body.skeleton.chain_dofs[a.chain]]
        same = (own[:, None] == a.angles[None]).all(2)
        assert (same.sum(1) == 1).all()
        columns.append(same.argmax(1))
    return list(zip(*(map(int, c) for c in columns)))


@pytest.mark.parametrize(('modes', 'sizes'), [(1, (4, 3, 5)), (3, (3, 4, 2)), (2, (1, 6, 1))])
def test_all_combinations(human32, modes, sizes):
    poses, log_weights, alternatives, changes = group_of(human32, modes, sizes, 0)
    found = best_combinations(
        human32, poses, log_weights, 17.0, alternatives, changes, TEMPERATURE, 1000
    )
    wanted = enumerated(log_weights, alternatives, changes, 17.0)
    assert found_picks(human32, found, alternatives) == [w[1] for w in wanted]
    assert list(found.parents) == [w[2] for w in wanted]
    assert np.allclose(found.energies, [w[3] for w in wanted], atol=1e-12)
    assert np.allclose(found.log_priors, [w[4] for w in wanted], atol=1e-12)
    # What belongs to no chain is the parent's.
    own = np.concatenate([human32.skeleton.chain_dofs[c] for c in CHAINS])
    others = np.setdiff1d(np.arange(human32.dimension), own)
    assert np.array_equal(found.poses[:, others], poses[found.parents][:, others])


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('count', [1, 7, 25])
def test_the_best_of_many(human32, seed, count):
    """Without building the product: 8 x 9 x 7 combinations of 4 modes."""
    poses, log_weights, alternatives, changes = group_of(human32, 4, (8, 9, 7), seed)
    found = best_combinations(
        human32, poses, log_weights, -3.0, alternatives, changes, TEMPERATURE, count
    )
    wanted = enumerated(log_weights, alternatives, changes, -3.0)[:count]
    assert len(found.poses) == count
    assert found_picks(human32, found, alternatives) == [w[1] for w in wanted]
    assert list(found.parents) == [w[2] for w in wanted]
    assert np.allclose(found.energies, [w[3] for w in wanted], atol=1e-12)
    # Modes in which a combination is not among the best may be left out of its probability.
    assert (found.log_priors <= np.array([w[4] for w in wanted]) + 1e-12).all()
    assert (found.log_priors >= np.array([w[5] for w in wanted]) - 1e-12).all()


def test_modes_are_not_changed(human32):
    poses, log_weights, alternatives, changes = group_of(human32, 2, (3, 3, 3), 1)
    before = poses.copy()
    best_combinations(human32, poses, log_weights, 0.0, alternatives, changes, TEMPERATURE, 9)
    assert np.array_equal(poses, before)


def test_a_group_whose_chains_are_its_own_gives_its_modes(human32):
    """Jumps that cost too much leave each mode with its own limbs, by weight."""
    rng = np.random.default_rng(2)
    poses = rng.normal(size=(3, human32.dimension))
    log_weights = np.log([0.2, 0.5, 0.3])
    alternatives = [
        Alternatives(c, poses[:, human32.skeleton.chain_dofs[c]], 1e3 * (1 - np.eye(3)))
        for c in CHAINS
    ]
    found = best_combinations(
        human32, poses, log_weights, 1.0, alternatives, [np.zeros(3)] * 3, TEMPERATURE, 3
    )
    assert list(found.parents) == [1, 2, 0]
    assert np.array_equal(found.poses, poses[[1, 2, 0]])
    assert np.allclose(found.log_priors, np.log([0.5, 0.3, 0.2]), atol=1e-12)


def joints_of(body, pose, chain, angles):
    poses = np.repeat(pose[None], len(angles), axis=0)
    poses[:, body.skeleton.chain_dofs[chain]] = angles
    names = {'left_arm': ('left_elbow', 'left_wrist', 'left_hand')}[chain]
    return body.joint_positions(poses)[:, body.skeleton.joint_index(names)]


def many_arms(body, count, seed):
    rng = np.random.default_rng(seed)
    own = body.skeleton.chain_dofs['left_arm']
    return rng.uniform(body.lower[own], body.upper[own], (count, len(own)))


@pytest.mark.parametrize('apart', [0.02, 0.1, 0.4])
def test_alternatives_are_distinct_and_stand_for_all(human32, apart):
    pose = human32.prior_mean.copy()
    angles = many_arms(human32, 120, 3)
    penalties = np.random.default_rng(4).exponential(1.0, (2, 120))
    found = distinct_alternatives(human32, pose, 'left_arm', angles, penalties, apart, 1000)
    joints = joints_of(human32, pose, 'left_arm', angles)
    gaps = np.linalg.norm(joints[:, None] - joints[None], axis=3).max(2)
    # In the order in which they come: a new one, or merged into the nearest before.
    kept: list[int] = []
    costs = penalties.copy()
    for i in range(120):
        near = sorted((gaps[i, k], k) for k in kept)
        if near and near[0][0] < apart:
            k = near[0][1]
            costs[:, k] = np.minimum(costs[:, k], penalties[:, i])
        else:
            kept.append(i)
    assert len(kept) > 1
    assert (len(kept) < 120) == (apart > 0.05)
    assert np.array_equal(found.angles, angles[kept])
    assert np.array_equal(found.penalties, costs[:, kept])
    assert found.chain == 'left_arm'
    inner = gaps[np.ix_(kept, kept)][~np.eye(len(kept), dtype=bool)]
    assert inner.min() >= apart


def test_the_first_are_kept_when_there_are_too_many(human32):
    pose = human32.prior_mean.copy()
    angles = many_arms(human32, 40, 5)
    penalties = np.zeros((1, 40))
    everything = distinct_alternatives(human32, pose, 'left_arm', angles, penalties, 0.05, 1000)
    few = distinct_alternatives(human32, pose, 'left_arm', angles, penalties, 0.05, 4)
    assert np.array_equal(few.angles, everything.angles[:4])


def test_copies_merge_into_the_first(human32):
    pose = human32.prior_mean.copy()
    (arm,) = many_arms(human32, 1, 6)
    penalties = np.array([[2.0, 0.5, 3.0], [0.0, 1.0, 4.0]])
    found = distinct_alternatives(
        human32, pose, 'left_arm', np.tile(arm, (3, 1)), penalties, 0.08, 10
    )
    assert np.array_equal(found.angles, [arm])
    assert np.array_equal(found.penalties, [[0.5], [0.0]])
    assert np.array_equal(penalties, [[2.0, 0.5, 3.0], [0.0, 1.0, 4.0]])
