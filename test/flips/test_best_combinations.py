"""Best sums, products of chain alternatives and distinct poses against full enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.special import logsumexp

from hmt_ros.body import load_body
from hmt_ros.flips.best_combinations import (
    Alternatives,
    best_combinations,
    distinct_alternatives,
    distinct_poses,
    least_sums,
)

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


@pytest.mark.parametrize('count', [1, 5, 40, 1000])
@pytest.mark.parametrize('ruled_out', [False, True])
def test_least_sums_of_lists_with_ties(count, ruled_out):
    """Costs are small whole numbers, so that sums are exact and often equal."""
    rng = np.random.default_rng(count)
    costs = [rng.integers(0, 4, size).astype(float) for size in (4, 5, 3, 4)]
    tables = {(0, 1): rng.random((4, 5)) < 0.7, (1, 3): rng.random((5, 4)) < 0.7}
    allowed = tables if ruled_out else None
    sums, picks = least_sums(costs, count, allowed)
    wanted = sorted(
        sum(cost[i] for cost, i in zip(costs, pick))
        for pick in itertools.product(*(range(len(cost)) for cost in costs))
        if not ruled_out or all(table[pick[i], pick[j]] for (i, j), table in tables.items())
    )
    assert sums.tolist() == wanted[:count]
    assert len({tuple(pick) for pick in picks.tolist()}) == len(sums)
    assert np.array_equal(sum(cost[i] for cost, i in zip(costs, picks.T)), sums)
    if ruled_out:
        assert all(table[picks[:, i], picks[:, j]].all() for (i, j), table in tables.items())


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


@pytest.fixture(scope='module')
def body():
    return load_body('human34')


def other_angles(body, pose, dofs):
    """The same rotation under its other triple Rx(a + pi) Ry(pi - b) Rz(c + pi)."""
    i, j, k = body.skeleton.dof_index(dofs)
    other = pose.copy()
    other[[i, j, k]] = pose[i] + np.pi, np.pi - pose[j], pose[k] + np.pi
    return other


def test_a_pose_under_other_angles_counts_once(body, random_poses):
    (pose,) = random_poses(body, 1, 0)
    same = [pose]
    for limb in ('left_shoulder', 'right_shoulder', 'left_hip', 'right_hip'):
        same += [other_angles(body, p, [f'{limb}_{x}' for x in 'xyz']) for p in list(same)]
    same.append(pose + 2 * np.pi * body.skeleton.dof_is_rotation)
    same = np.array(same)
    assert len(same) == 17
    assert np.abs(same[1:] - pose).max(1).min() > 1.0
    assert distinct_poses(body.joint_positions(same), 1e-6).kept.tolist() == [0]


def test_the_twist_of_a_straight_limb_makes_no_other_pose(body):
    poses = np.tile(body.prior_mean, (2, 1))
    poses[:, 2] = 3.0
    poses[:, body.skeleton.dof_index(['left_elbow', 'left_wrist_x', 'left_wrist_y'])] = 0.0
    poses[1, body.dof_names.index('left_shoulder_z')] += 0.8
    assert len(distinct_poses(body.joint_positions(poses), 1e-6).kept) == 1
    poses[:, body.dof_names.index('left_elbow')] = 0.5
    assert len(distinct_poses(body.joint_positions(poses), 1e-2).kept) == 2


@pytest.mark.parametrize('most', [None, 5])
def test_it_is_what_all_pairs_say(most):
    rng = np.random.default_rng(1)
    joints = rng.uniform(-1, 1, (12, 1, 4, 3)) + rng.uniform(-0.2, 0.2, (12, 20, 4, 3))
    joints = rng.permutation(joints.reshape(-1, 4, 3))
    kept, owner = [], []
    for i in range(len(joints)):
        gaps = np.linalg.norm(joints[kept] - joints[i], axis=2).max(1) if kept else np.array([9.0])
        if gaps.min() < 0.3:
            owner.append(int(gaps.argmin()))
        elif most is None or len(kept) < most:
            owner.append(len(kept))
            kept.append(i)
        else:
            owner.append(-1)
    found = distinct_poses(joints, 0.3, most)
    assert found.kept.tolist() == kept
    assert found.owner.tolist() == owner
    assert len(kept) > 4


def test_no_poses_and_wrong_shapes():
    kept, owner = distinct_poses(np.empty((0, 5, 3)), 0.1)
    assert (len(kept), len(owner)) == (0, 0)
    with pytest.raises(ValueError, match=r'shape \(N, J, 3\), saw \(4, 3\)'):
        distinct_poses(np.zeros((4, 3)), 0.1)
