"""The point estimate: a motion by the dynamics, and never between two ways to face."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.body.mirror import left_directions, reverse_depth
from hmt_ros.body.motion_prior import motion_prior
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.tracking.point_estimate import PointEstimate
from hmt_ros.tracking.settings import FACING_VALID

DT = 1.0 / 30.0


@pytest.fixture
def pose(human37):
    result = human37.prior_mean.copy()
    result[:3] = (0.1, 0.0, 4.0)
    return np.clip(result, human37.lower + 0.2, human37.upper - 0.2)


@pytest.fixture
def dynamics(human37):
    return motion_prior(human37)


def mixture(poses, weights=(1.0,), variance=1e-3, seed=None):
    """Components of one variance, or of random covariances about as large."""
    poses = np.atleast_2d(poses)
    k, d = poses.shape
    covariances = np.tile(variance * np.eye(d), (k, 1, 1))
    if seed is not None:
        root = np.random.default_rng(seed).normal(size=(k, d, d))
        covariances = covariances + variance * root @ root.transpose(0, 2, 1) / d
    return GaussianMixture(np.array(weights), poses, covariances)


@pytest.mark.parametrize('walks', [False, True])
def test_it_is_the_mean_of_all_images_under_the_dynamics(human37, pose, dynamics, walks):
    """Uneven intervals and a gap, against one dense system over all states."""
    if walks:
        dynamics = LinearGaussianDynamics.random_walk(human37.rates)
    d, n = human37.dimension, dynamics.state_dimension
    rng = np.random.default_rng(1)
    gaps = [DT, DT, 0.1, 0.01, 1.0, DT]
    images = [
        mixture(pose + 0.01 * rng.normal(size=(2, d)), (0.7, 0.3), 1e-3, seed)
        for seed in range(len(gaps) + 1)
    ]
    estimate = PointEstimate()
    for one, dt in zip(images, [None, *gaps]):
        estimate.update(human37, dynamics, one, dt)
    # Nothing is known of the first pose; its velocity is what the dynamics expect.
    first = np.zeros((n, n))
    first[d:, d:] = np.linalg.inv(dynamics.unknown_velocity) if n > d else 0.0
    times = len(images)
    precision, information = np.zeros((times * n, times * n)), np.zeros(times * n)
    precision[:n, :n], information[:n] = first, first @ dynamics.initial_mean
    for t, one in enumerate(images):
        if t:
            a, q = dynamics.transition(gaps[t - 1])
            both = np.hstack([-a, np.eye(n)])
            own = slice((t - 1) * n, (t + 1) * n)
            precision[own, own] += both.T @ np.linalg.solve(q, both)
        seen = np.linalg.inv(0.7 * one.covariances[0] + 0.3 * one.covariances[1])
        own = slice(t * n, t * n + d)
        precision[own, own] += seen
        information[own] += seen @ (0.7 * one.means[0] + 0.3 * one.means[1])
    wanted = np.linalg.solve(precision, information)[-n:][:d]
    assert estimate.pose == pytest.approx(wanted, abs=1e-6)
    # It is neither the last image nor the first.
    assert np.abs(estimate.pose - images[-1].mean()).max() > 1e-3


def test_it_trembles_less_than_the_modes_and_follows_them(human37, pose, dynamics):
    estimate, shown, given = PointEstimate(), [], []
    knee = human37.dof_names.index('left_knee')
    rng = np.random.default_rng(0)
    for t in range(60):
        moved = pose + rng.normal(0.0, 0.03, len(pose))
        moved[knee] = -0.3 - 0.02 * t + 0.03 * (-1) ** t
        moved = np.clip(moved, human37.lower, human37.upper)
        given.append(moved[knee])
        estimate.update(human37, dynamics, mixture(moved, variance=0.01), DT if t else None)
        shown.append(estimate.pose[knee])
    tremble = [np.abs(np.diff(x[10:], n=2)).mean() for x in (shown, given)]
    assert tremble[0] < 0.5 * tremble[1]
    late = -0.3 - 0.02 * np.arange(60) - shown
    assert np.abs(late[20:]).max() < 0.06


def test_it_keeps_its_way_until_no_image_may_be_wrong_by_so_much(human37, pose, dynamics):
    estimate = PointEstimate()
    both = np.concatenate([pose[None], reverse_depth(human37, pose[None])])
    way = left_directions(human37, both)
    estimate.update(human37, dynamics, mixture(both[:1]), None)
    for share, wanted in (
        (FACING_VALID - 0.01, 0),
        (FACING_VALID + 0.01, 1),
        (1.0 - FACING_VALID + 0.01, 1),
    ):
        estimate.update(human37, dynamics, mixture(both, (1.0 - share, share)), DT)
        assert left_directions(human37, estimate.pose[None])[0] @ way[wanted] > 0.99
        # No pose between the two ways.
        assert estimate.pose == pytest.approx(both[wanted], abs=1e-6)


def test_a_turn_over_half_a_circle_is_the_short_way(human37, pose, dynamics):
    estimate = PointEstimate()
    root_z = human37.dof_names.index('root_z')
    first, second = pose.copy(), pose.copy()
    first[root_z], second[root_z] = np.pi - 0.02, -np.pi + 0.02
    estimate.update(human37, dynamics, mixture(first), None)
    estimate.update(human37, dynamics, mixture(second), DT)
    ways = left_directions(human37, np.stack([first, estimate.pose, second]))
    assert ways[1] @ ways[0] > ways[2] @ ways[0] - 1e-6
    # Turns are counted as the modes count them.
    assert abs(estimate.pose[root_z] - second[root_z]) < 0.1


def test_while_nothing_is_seen_the_motion_goes_on(human37, pose, dynamics):
    moving, other = PointEstimate(), PointEstimate()
    for t in range(20):
        now = pose.copy()
        now[0] += 0.03 * t
        for estimate in (moving, other):
            estimate.update(human37, dynamics, mixture(now), DT if t else None)
    before = moving.pose.copy()
    moving.expect(human37, dynamics, 0.3)
    assert 0.1 < moving.pose[0] - before[0] < 0.3
    assert np.abs(np.delete(moving.pose - before, 0)).max() < 0.05
    # What was expected is no evidence.
    later = now.copy()
    later[0] += 0.3
    for estimate in (moving, other):
        estimate.update(human37, dynamics, mixture(later), 0.4)
    assert np.array_equal(moving.pose, other.pose)
