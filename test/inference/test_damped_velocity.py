"""Damped velocities with coupled noise, compared with the general transition and small steps."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.inference.damped_velocity import DampedVelocity
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics

DAMPING = np.array([0.3, 5.0, 40.0])
DIFFUSION = np.array([[2.0, 0.8, -1.0], [0.8, 9.0, 3.0], [-1.0, 3.0, 30.0]])
WHITE = np.array([1e-5, 1e-3, 0.02])


@pytest.fixture
def dynamics() -> DampedVelocity:
    return DampedVelocity.of(DAMPING, DIFFUSION, WHITE)


@pytest.mark.parametrize('interval', [1e-4, 1 / 30, 0.0999, 0.1001, 0.3])
def test_transitions_are_those_of_the_general_dynamics(dynamics, interval):
    general = LinearGaussianDynamics(
        dynamics.drift, dynamics.diffusion, 3, np.zeros(6), np.zeros((6, 6))
    )
    a, q = dynamics.transition(interval)
    b, r = general.transition(interval)
    np.testing.assert_allclose(a, b, atol=1e-12)
    # Van Loan's matrix exponential has entries of exp(40 t), which cost it digits.
    np.testing.assert_allclose(q, r, rtol=1e-5, atol=1e-12)
    assert np.linalg.eigvalsh(q)[0] > 0


def test_transitions_are_the_limit_of_small_steps(dynamics):
    """Euler's method for the moments with 20000 steps."""
    interval, count = 0.2, 20_000
    h = interval / count
    step = np.eye(6) + h * dynamics.drift
    a, q = np.eye(6), np.zeros((6, 6))
    for _ in range(count):
        a, q = step @ a, step @ q @ step.T + h * dynamics.diffusion
    own, noise = dynamics.transition(interval)
    np.testing.assert_allclose(own, a, atol=1e-3)
    np.testing.assert_allclose(noise, q, rtol=2e-3, atol=1e-4)


def test_predictions_are_those_of_the_transition(dynamics):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 6, 6))
    means, covariances = rng.normal(size=(4, 6)), root @ root.swapaxes(1, 2)
    moved, spread = dynamics.predict(means, covariances, 0.07)
    a, q = dynamics.transition(0.07)
    np.testing.assert_allclose(moved, means @ a.T, atol=1e-14)
    np.testing.assert_allclose(spread, a @ covariances @ a.T + q, atol=1e-12)


def test_long_intervals_are_many_short_ones(dynamics):
    a, q = np.eye(6), np.zeros((6, 6))
    step, noise = dynamics.transition(0.05)
    for _ in range(100):
        a, q = step @ a, step @ q @ step.T + noise
    own, whole = dynamics.transition(5.0)
    np.testing.assert_allclose(own, a, atol=1e-12)
    np.testing.assert_allclose(whole, q, atol=1e-9)


@pytest.mark.parametrize(('first', 'second'), [(0.03, 0.04), (0.02, 0.3), (1.0, 0.001)])
def test_two_predictions_are_one_over_the_sum_of_times(dynamics, first, second):
    rng = np.random.default_rng(1)
    root = rng.normal(size=(2, 6, 6))
    start = rng.normal(size=(2, 6)), root @ root.swapaxes(1, 2)
    twice = dynamics.predict(*dynamics.predict(*start, first), second)
    once = dynamics.predict(*start, first + second)
    for got, wanted in zip(twice, once, strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-11)


def test_the_velocity_begins_and_stays_with_the_stationary_covariance(dynamics):
    stationary = DIFFUSION / (DAMPING[:, None] + DAMPING)
    np.testing.assert_allclose(dynamics.unknown_velocity, stationary, atol=1e-12)
    start = dynamics.states(np.zeros((1, 3, 3)))
    _, later = dynamics.predict(np.zeros((1, 6)), start, 0.4)
    np.testing.assert_allclose(later[0, 3:, 3:], stationary, atol=1e-12)


def test_poses_of_unknown_velocity_gain_what_the_stationary_velocity_moves(dynamics):
    means, covariances = np.ones((1, 3)), np.eye(3)[None]
    moved, spread = dynamics.predict_poses(means, covariances, 0.2)
    np.testing.assert_allclose(moved, means)
    variance = DIFFUSION[0, 0] / (2 * DAMPING[0])
    x = DAMPING[0] * 0.2
    gained = 2 * variance / DAMPING[0] ** 2 * (x - 1 + np.exp(-x)) + WHITE[0] * 0.2
    assert spread[0, 0, 0] - 1.0 == pytest.approx(gained, rel=1e-9)


def test_a_random_walk_knows_no_velocity():
    walk = LinearGaussianDynamics.random_walk([1.0, 2.0])
    start = np.zeros((1, 2)), np.eye(2)[None]
    assert walk.states(start[1]) is start[1]
    np.testing.assert_allclose(walk.predict_poses(*start, 0.5)[1][0], np.diag([1.5, 2.0]))


def test_transitions_are_kept_and_cannot_be_changed(dynamics):
    assert dynamics.transition(0.1)[1] is dynamics.transition(0.1)[1]
    with pytest.raises(ValueError, match='read-only'):
        dynamics.transition(0.1)[1][0, 0] = 1.0
    for i in range(200):
        dynamics.transition(0.2 + 1e-3 * i)
    np.testing.assert_array_equal(
        dynamics.transition(0.1)[1], DampedVelocity.of(DAMPING, DIFFUSION, WHITE).transition(0.1)[1]
    )


@pytest.mark.parametrize(
    ('damping', 'diffusion', 'white', 'message'),
    [
        ([0.0, 1.0], np.eye(2), [1.0, 1.0], 'damping must be positive'),
        ([1.0, 1.0], np.eye(2), [1.0, np.nan], 'white noise must be positive'),
        ([1.0, 1.0], np.eye(3), [1.0, 1.0], 'do not fit'),
        ([1.0, 1.0], [[1.0, 2.0], [2.0, 1.0]], [1.0, 1.0], 'not positive definite'),
    ],
)
def test_bad_dynamics_are_refused(damping, diffusion, white, message):
    with pytest.raises(ValueError, match=message):
        DampedVelocity.of(damping, diffusion, white)
