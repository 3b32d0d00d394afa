"""Weights, compared with their equations by plain loops and by enumeration of all paths."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hmt_ros.body.mirror import reverse_depth
from hmt_ros.tracking.settings import END_NATS, TRANSITION_SPREAD, TRANSITION_TAILS
from hmt_ros.tracking.weighting import TransitionPrior, normalised, pooled_origins


@pytest.fixture(scope='module')
def poses_near(human32, motion):
    """Function (n, seed, spread in rad) -> poses (n, d) around one of the motion."""

    def draw(n: int, seed: int = 0, spread: float = 0.1) -> np.ndarray:
        rng = np.random.default_rng(seed)
        poses = motion[0] + spread * rng.normal(size=(n, human32.dimension))
        return np.clip(poses, human32.lower, human32.upper)

    return draw


def log_transition(body, pose, expected, dt):
    """Equation (3), joint by joint."""
    a, b = (body.joint_positions(x[None])[0] for x in (pose, expected))
    total = 0.0
    for p, q in zip(a, b):
        total += sum(((p[i] - a[0][i]) - (q[i] - b[0][i])) ** 2 for i in range(3))
    distance = total / len(a)
    return (
        -TRANSITION_TAILS / 2 * np.log(1 + distance / (TRANSITION_TAILS * TRANSITION_SPREAD * dt))
    )


def transition(body, pose, expected, all_poses, dt):
    """p(x_k | x_j), equation (2)."""

    def share(x):
        crowd = sum(np.exp(log_transition(body, x, other, dt)) for other in all_poses)
        return np.exp(log_transition(body, x, expected, dt)) / crowd

    return share(pose) / (sum(share(x) for x in all_poses) + np.exp(-END_NATS))


def log_histories(transition_prior, poses):
    """log w_k p(x_n | x_k), (K, N)."""
    joints = transition_prior.body.joint_positions(poses)
    return transition_prior.log_histories(joints, transition_prior.log_transitions(joints))


def log_priors(transition_prior, poses):
    """log sum_k w_k p(x_n | x_k), (N,)."""
    return np.logaddexp.reduce(log_histories(transition_prior, poses), axis=0)


@pytest.mark.parametrize('dt', [0.01, 0.1, 3.0])
def test_transitions_are_a_student_density_of_the_joints(human32, poses_near, dt):
    before, poses = poses_near(3, 1), poses_near(5, 2, 0.3)
    joints = human32.joint_positions(poses)
    found = TransitionPrior(human32, before, np.zeros(3), dt).log_transitions(joints)
    wanted = [[log_transition(human32, x, b, dt) for x in poses] for b in before]
    assert found == pytest.approx(np.array(wanted), abs=1e-9)


def test_weights_are_the_sum_over_all_paths(human32, poses_near):
    """With three modes in four images, the recursion equals the sum over all 3^4 paths."""
    images, count = 4, 3
    rng = np.random.default_rng(0)
    poses = [poses_near(count, 10 + t, 0.15) for t in range(images)]
    moved = [x + 0.02 * rng.normal(size=x.shape) for x in poses]
    evidence = rng.uniform(0.0, 4.0, (images, count))
    first = normalised(rng.normal(size=count))
    gaps = (0.1, 0.03, 0.4)
    log_weights = normalised(first - evidence[0])
    for t in range(1, images):
        transition_prior = TransitionPrior(human32, moved[t - 1], log_weights, gaps[t - 1])
        log_weights = normalised(log_priors(transition_prior, poses[t]) - evidence[t])
    wanted = np.zeros(count)
    for path in itertools.product(range(count), repeat=images):
        share = np.exp(first[path[0]] - evidence[0, path[0]])
        for t in range(1, images):
            j, k = path[t - 1], path[t]
            share *= transition(human32, poses[t][k], moved[t - 1][j], poses[t], gaps[t - 1])
            share *= np.exp(-evidence[t, k])
        wanted[path[-1]] += share
    assert np.exp(log_weights) == pytest.approx(wanted / wanted.sum(), rel=1e-10)
    assert np.ptp(log_weights) > 0.5


def test_a_mode_without_continuation_ends(human32, poses_near):
    """A pose more likely than e^-c gets a mode's whole mass, a less likely one a share."""
    near = poses_near(1)
    far = reverse_depth(human32, near)
    both = np.concatenate([near, far])
    dt = 1e-4
    apart = log_transition(human32, near[0], far[0], dt)
    assert apart < -END_NATS - 1.0
    transition_prior = TransitionPrior(human32, both, np.log([0.5, 0.5]), dt)
    left = np.exp(log_priors(transition_prior, near))
    stayed = 1.0 / (1.0 + np.exp(-END_NATS))
    crossed = np.exp(apart) / (np.exp(apart) + np.exp(-END_NATS))
    assert left == pytest.approx(0.5 * (stayed + crossed), rel=1e-6)
    # The mode without a continuation loses most of its mass.
    assert crossed < np.exp(apart + END_NATS) < 0.3
    # With a continuation for each mode, nearly nothing is lost.
    assert np.exp(log_priors(transition_prior, both)).sum() > 0.98


@pytest.mark.parametrize('copies', [2, 10, 100])
def test_copies_of_a_continuation_do_not_multiply_the_mass_of_a_mode(human32, poses_near, copies):
    """Two modes continue: one as one hypothesis, the other as many nearly equal ones."""
    a = poses_near(1, 1)
    b = reverse_depth(human32, a)
    near = np.repeat(b, copies, axis=0)
    near[:, 7:] += 1e-4 * np.random.default_rng(0).normal(size=near[:, 7:].shape)
    near = np.clip(near, human32.lower, human32.upper)
    dt = 1e-5
    transition_prior = TransitionPrior(human32, np.concatenate([a, b]), np.log([0.7, 0.3]), dt)
    weights = np.exp(log_priors(transition_prior, np.concatenate([a, near])))
    assert weights[0] == pytest.approx(0.7, rel=0.02)
    assert weights[1:].sum() == pytest.approx(0.3, rel=0.1)
    # Each alone would have the whole weight of the mode.
    assert np.exp(transition_prior.log_predictive(human32.joint_positions(near))) == pytest.approx(
        0.3, rel=0.1
    )


def test_copies_of_a_motion_draw_no_weight_from_another(human32, poses_near):
    """Two arm poses over a second: one is found once, the other `copies` times."""
    a, dt = poses_near(1, 1)[0], 1.0 / 30.0
    b, near = a.copy(), 0.005
    b[human32.skeleton.chain_dofs['left_arm'][0]] += 0.8
    copies = np.array([b + near * k / human32.dimension**0.5 for k in range(-3, 4)])
    poses = np.concatenate([a[None], copies])
    weights = np.concatenate([[0.5], np.full(7, 0.5 / 7)])
    for _ in range(30):
        transition_prior = TransitionPrior(human32, poses, np.log(weights), dt)
        weights = np.exp(normalised(log_priors(transition_prior, poses)))
    assert weights[0] == pytest.approx(0.5, abs=0.1)
    # Transitions between the two are possible.
    ways = np.exp(log_histories(transition_prior, poses) - np.log(weights)[:, None])
    assert ways[0, 1:].sum() > 0.01


@pytest.mark.parametrize('dt', [1e-9, 1000.0])
def test_gaps_of_any_length_give_finite_numbers(human32, poses_near, dt):
    before, poses = poses_near(3, 1), poses_near(4, 2, 1.0)
    transition_prior = TransitionPrior(human32, before, np.log([0.9, 0.1, 1e-6]), dt)
    log_predictive = transition_prior.log_predictive(human32.joint_positions(poses))
    for found in (log_priors(transition_prior, poses), log_predictive):
        assert np.isfinite(found).all()
    if dt > 1.0:
        # After a long time every pose continues every mode equally.
        assert np.exp(log_priors(transition_prior, poses)) == pytest.approx(0.25, rel=0.02)


def test_origins_of_modes_that_stand_for_several():
    rng = np.random.default_rng(0)
    histories, log_weights = rng.normal(size=(3, 6)), rng.normal(size=6)
    owner = np.array([0, 1, 0, 2, 2, 0])
    found = pooled_origins(histories, log_weights, owner)
    for m in range(3):
        wanted, total = np.zeros(3), 0.0
        for n in np.flatnonzero(owner == m):
            own = np.exp(histories[:, n]) / np.exp(histories[:, n]).sum()
            wanted += np.exp(log_weights[n]) * own
            total += np.exp(log_weights[n])
        assert found[m] == pytest.approx(wanted / total, abs=1e-12)
