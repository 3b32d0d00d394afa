"""Dynamics in continuous time against integrals, compositions and sums of log densities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import multivariate_normal

from hmt_ros.smoothing import LinearGaussianDynamics

FIRST = np.array([[1.0, 0.2], [0.2, 2.0]])
WALK = replace(
    LinearGaussianDynamics.random_walk([1.0, 2.0]),
    initial_mean=[0.5, 0.0],
    initial_precision=np.linalg.inv(FIRST),
)
FAST = LinearGaussianDynamics.constant_velocity([1.0, 2.0], [0.5, 0.4])
TURN = LinearGaussianDynamics(
    drift=np.array([[-0.1, 0.12], [-0.12, -0.22]]),
    diffusion=np.array([[1.1, 0.1], [0.1, 0.6]]),
    dimension=2,
    initial_mean=np.zeros(2),
    initial_precision=np.zeros((2, 2)),
)


@pytest.mark.parametrize('dynamics', [WALK, FAST, TURN])
def test_noise_is_the_integral_of_what_the_drift_makes_of_white_noise(dynamics):
    a, q = dynamics.transition(0.7)
    np.testing.assert_allclose(a, expm(0.7 * dynamics.drift), atol=1e-12)
    s, weights = np.polynomial.legendre.leggauss(20)
    moves = [expm(0.35 * (x + 1) * dynamics.drift) for x in s]
    integral = sum(0.35 * w * m @ dynamics.diffusion @ m.T for w, m in zip(weights, moves))
    np.testing.assert_allclose(q, integral, atol=1e-10)


@pytest.mark.parametrize('dynamics', [WALK, FAST, TURN])
def test_two_intervals_are_one(dynamics):
    (a, q), (b, r), (c, s) = (dynamics.transition(x) for x in (0.3, 0.5, 0.8))
    np.testing.assert_allclose(b @ a, c, atol=1e-12)
    np.testing.assert_allclose(b @ q @ b.T + r, s, atol=1e-12)


def test_the_prior_is_the_sum_of_log_densities():
    intervals = np.array([0.3, 0.1, 0.3])
    x = np.random.default_rng(0).normal(size=(4, 2))
    prior = WALK.prior(intervals)
    energy, gradient = prior.energy(x[None])
    expected = multivariate_normal([0.5, 0.0], FIRST).logpdf(x[0])
    for before, after, interval in zip(x, x[1:], intervals):
        a, q = WALK.transition(interval)
        expected += multivariate_normal(a @ before, q).logpdf(after)
    assert energy[0] == pytest.approx(-expected)
    step = 1e-6 * np.eye(8).reshape(8, 4, 2)
    numeric = (prior.energy(x + step)[0] - prior.energy(x - step)[0]) / 2e-6
    np.testing.assert_allclose(gradient.reshape(-1), numeric, atol=1e-6)


def test_velocities_couple_the_band_no_more_than_they_must():
    prior = FAST.prior(np.full(5, 0.1))
    assert prior.precision.bandwidth == 6
    assert prior.dimension == 2


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda: LinearGaussianDynamics.random_walk([1.0, -1.0]), 'positive semi-definite'),
        (lambda: LinearGaussianDynamics.random_walk([np.nan]), 'not finite'),
        (lambda: LinearGaussianDynamics.random_walk([1.0], step=0.0), 'step must be positive'),
        (lambda: LinearGaussianDynamics.constant_velocity([1.0], 0.0), 'velocity_sigma'),
        (lambda: LinearGaussianDynamics.random_walk([1.0, 0.0]).prior(np.ones(2)), 'positive rate'),
    ],
)
def test_bad_dynamics_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    'dynamics',
    [
        LinearGaussianDynamics.random_walk([1.0, 2.0]),
        LinearGaussianDynamics.constant_velocity([1.0], 2.0),
    ],
)
def test_modes_are_predicted_in_one_go_as_in_two(dynamics):
    means, covariances = np.array([[1.0, 2.0], [0.0, -1.0]]), np.array([np.eye(2), 3 * np.eye(2)])
    a, q = dynamics.transition(0.7)
    whole = dynamics.predict(means, covariances, 0.7)
    np.testing.assert_allclose(whole[0], [a @ mean for mean in means])
    np.testing.assert_allclose(whole[1], [a @ s @ a.T + q for s in covariances])
    for one, other in zip(dynamics.predict(*dynamics.predict(means, covariances, 0.3), 0.4), whole):
        np.testing.assert_allclose(one, other, rtol=1e-9)
