"""Refined trajectories, compared with dense optimisers; limits, and hard cases."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.optimize import minimize

from hmt_ros.inference import GaussianMixture, Status
from hmt_ros.inference.energy import Derivatives, Energy
from hmt_ros.smoothing import LinearGaussianDynamics
from hmt_ros.smoothing.likelihood import MixtureLikelihood
from hmt_ros.smoothing.mode_sequence import ModeSequence, path_gaussians
from hmt_ros.smoothing.trajectory_refinement import refine

FAST = LinearGaussianDynamics.constant_velocity([4.0, 4.0], 1.0)


def energy_of(sequence: ModeSequence):
    """E and its gradient of one trajectory as a flat vector."""
    prior, likelihood = sequence.prior, sequence.likelihood
    times, n = prior.information.shape
    d = prior.dimension

    def function(flat):
        x = flat.reshape(1, times, n)
        value, gradient = prior.energy(x)
        seen, slope, _ = likelihood.energy(x[0, :, :d], np.arange(times))
        gradient[0, :, :d] += slope
        return value[0] + seen.sum(), gradient.reshape(-1)

    return function


@pytest.mark.parametrize('derivatives', [Derivatives.POSITIVE, Derivatives.EXACT])
def test_likelihood_of_mixtures(modes, derivatives):
    mixtures = modes(1.0)
    likelihood = MixtureLikelihood.of(mixtures)
    rng = np.random.default_rng(0)
    x, times = rng.normal(size=(30, 2)), rng.integers(0, 5, 30)
    value, gradient, hessian = likelihood.energy(x, times, derivatives=derivatives)
    expected = [-mixtures[t].log_density(p[None])[0] for t, p in zip(times, x)]
    np.testing.assert_allclose(value, expected, atol=1e-12)
    for a, step in enumerate(1e-6 * np.eye(2)):
        up = likelihood.energy(x + step, times, derivatives=Derivatives.GRADIENT)
        down = likelihood.energy(x - step, times, derivatives=Derivatives.GRADIENT)
        np.testing.assert_allclose(gradient[:, a], (up[0] - down[0]) / 2e-6, atol=1e-7)
        if derivatives == Derivatives.EXACT:
            np.testing.assert_allclose(hessian[:, a], (up[1] - down[1]) / 2e-6, atol=1e-7)
    if derivatives == Derivatives.POSITIVE:
        assert np.linalg.eigvalsh(hessian).min() > 0


@pytest.mark.parametrize('dynamics', [LinearGaussianDynamics.random_walk([1.0, 2.0]), FAST])
@pytest.mark.parametrize('radius', [0.7, 3.0])
def test_optima_are_those_of_a_dense_optimiser(modes, dynamics, radius):
    sequence = ModeSequence(tuple(modes(radius)), dynamics, np.array([0.5, 1.0, 0.2, 1.0]))
    starts = sequence.states(sequence.paths(6))
    found = refine(starts, sequence.prior, sequence.likelihood)
    assert (found.status == Status.CONVERGED).all()
    assert found.iterations.max() <= 20
    function = energy_of(sequence)
    for i in range(6):
        value, gradient = function(found.states[i].reshape(-1))
        assert value == pytest.approx(found.energies[i])
        best = minimize(function, found.states[i].reshape(-1), jac=True, options={'gtol': 1e-9})
        assert value - best.fun < 1e-6
        assert value <= function(starts[i].reshape(-1))[0]
        assert np.abs(gradient).max() < 0.05


def test_the_factor_at_an_optimum_is_that_of_its_hessian(modes, walk):
    sequence = ModeSequence(tuple(modes(0.7)), walk, np.ones(4))
    found = refine(sequence.states(sequence.paths(2)), sequence.prior, sequence.likelihood)
    function = energy_of(sequence)
    flat = found.states[0].reshape(-1)
    rows = [
        (function(flat + step)[1] - function(flat - step)[1]) / 2e-5 for step in 1e-5 * np.eye(10)
    ]
    covariances = found.factors[0].inverse_blocks()
    inverse = np.linalg.inv(rows).reshape(5, 2, 5, 2)
    for t in range(5):
        np.testing.assert_allclose(covariances[t], inverse[t, :, t], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize('dynamics', [LinearGaussianDynamics.random_walk([1.0, 2.0]), FAST])
def test_limits_hold_at_every_time(modes, dynamics):
    sequence = ModeSequence(tuple(modes(3.0)), dynamics, np.ones(4))
    low, high = np.array([-1.0, -2.0]), np.array([1.5, 0.4])
    starts = sequence.states(sequence.paths(9))
    found = refine(starts, sequence.prior, sequence.likelihood, low, high)
    poses = found.states[:, :, :2]
    assert ((poses >= low) & (poses <= high)).all()
    assert (~found.free).any()
    function = energy_of(sequence)
    n = dynamics.state_dimension
    bounds = [(-np.inf, np.inf)] * n
    bounds[:2] = list(zip(low, high))
    for i in range(9):
        gradient = function(found.states[i].reshape(-1))[1].reshape(5, n)
        assert np.abs(gradient[found.free[i]]).max() < 0.02
        outwards = np.where(found.states[i, :, :2] <= low, gradient[:, :2], -gradient[:, :2])
        assert (outwards[~found.free[i][:, :2]] > 0).all()
        best = minimize(
            function, found.states[i].reshape(-1), jac=True, method='L-BFGS-B', bounds=bounds * 5,
            options={'ftol': 1e-14, 'gtol': 1e-9},
        )  # fmt: skip
        assert found.energies[i] - best.fun < 1e-5


def test_a_variable_on_a_limit_has_the_variance_of_an_exponential():
    one = GaussianMixture([1.0], [[5.0]], [[[0.01]]])
    dynamics = LinearGaussianDynamics.random_walk([1.0])
    sequence = ModeSequence((one,), dynamics, np.zeros(0))
    found = refine(sequence.states(sequence.paths(1)), sequence.prior, sequence.likelihood, -1, 1)
    slope = 4.0 / 0.01
    variance = found.factors[0].inverse_blocks()[0, 0, 0]
    assert variance == pytest.approx(1 / (slope**2 + 100))


def test_a_start_between_two_modes_where_the_hessian_is_indefinite():
    two = GaussianMixture([0.5, 0.5], [[-2.0], [2.1]], [[[0.1]], [[0.1]]])
    dynamics = LinearGaussianDynamics.random_walk([1.0])
    sequence = ModeSequence((two,) * 4, dynamics, np.ones(3))
    found = refine(np.full((1, 4, 1), 0.02), sequence.prior, sequence.likelihood)
    assert found.status[0] == Status.CONVERGED
    assert np.abs(np.abs(found.states) - 2.05).max() < 0.1


def test_duplicates_are_merged(modes, walk):
    sequence = ModeSequence(tuple(modes(0.5)), walk, np.ones(4))
    found = refine(sequence.states(sequence.paths(30)), sequence.prior, sequence.likelihood)
    distinct = found.without_duplicates()
    assert len(distinct) < len(found)
    assert (np.diff(distinct.energies) >= 0).all()
    assert distinct.energies[0] == found.energies.min()
    for state in found.states:
        assert np.abs(distinct.states - state).max((1, 2)).min() < 0.05


def test_what_one_trajectory_finds_does_not_depend_on_the_others(modes, walk):
    sequence = ModeSequence(tuple(modes(0.7)), walk, np.ones(4))
    starts = sequence.states(sequence.paths(6))
    together = refine(starts, sequence.prior, sequence.likelihood)
    for i in range(6):
        alone = refine(starts[[i]], sequence.prior, sequence.likelihood)
        np.testing.assert_array_equal(alone.states[0], together.states[i])


@dataclass(frozen=True)
class Bearings:
    """Bearings of a point as evidence, with value, gradient and Gauss-Newton Hessian."""

    angles: np.ndarray
    sigma: float = 0.02

    @property
    def times(self) -> int:
        return len(self.angles)

    def energy(self, x, rows, *, derivatives=Derivatives.POSITIVE):
        away = (x**2).sum(1)
        residual = (np.arctan2(x[:, 1], x[:, 0]) - self.angles[rows]) / self.sigma
        jacobian = np.stack([-x[:, 1], x[:, 0]], axis=1) / away[:, None] / self.sigma
        hessian = jacobian[:, :, None] * jacobian[:, None, :]
        return Energy(0.5 * residual**2, residual[:, None] * jacobian, hessian)


def test_any_object_with_value_gradient_and_hessian_is_a_likelihood():
    truth = np.stack([np.linspace(3, 4, 8), np.linspace(-1, 1, 8)], axis=1)
    likelihood = Bearings(np.arctan2(truth[:, 1], truth[:, 0]))
    dynamics = replace(
        LinearGaussianDynamics.random_walk([0.2, 0.2]),
        initial_mean=truth[0],
        initial_precision=10.0 * np.eye(2),
    )
    prior = dynamics.prior(np.ones(7))
    found = refine(np.full((1, 8, 2), [3.0, 0.5]), prior, likelihood)
    assert found.status[0] == Status.CONVERGED
    seen = np.arctan2(found.states[0, :, 1], found.states[0, :, 0])
    np.testing.assert_allclose(seen, likelihood.angles, atol=0.03)


@pytest.mark.parametrize('radius', [0.5, 3.0])
def test_gaussians_of_all_paths_are_the_posterior(modes, walk, exact, radius):
    mixtures = modes(radius, times=4)
    sequence = ModeSequence(tuple(mixtures), walk, np.ones(3))
    found = path_gaussians(sequence.paths(81).nodes, sequence.prior, sequence.likelihood)
    evidence, marginals = exact(mixtures, walk, np.ones(3))
    assert np.logaddexp.reduce(found.log_weights) == pytest.approx(evidence)
    weights = np.exp(found.log_weights - evidence)
    for t, marginal in enumerate(marginals):
        np.testing.assert_allclose(weights @ found.states[:, t], marginal.mean(), atol=1e-9)
