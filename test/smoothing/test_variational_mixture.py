"""The free energy: its gradient, its descent, and the bounded quantity."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import logsumexp

from hmt_ros.smoothing import LinearGaussianDynamics
from hmt_ros.smoothing.mode_sequence import ModeSequence
from hmt_ros.smoothing.trajectory_refinement import refine
from hmt_ros.smoothing.variational_mixture import (
    FreeEnergy,
    antithetic,
    laplace_masses,
    minimise_free_energy,
)

SUBSETS = [
    ('weights',),
    ('inflation',),
    ('means',),
    ('weights', 'inflation'),
    ('weights', 'means', 'inflation'),
]


def laplace_weights(refined):
    masses = laplace_masses(refined.energies, refined.factors)
    return np.exp(masses - logsumexp(masses))


@pytest.fixture
def problem(modes, walk):
    """A sequence and its refined trajectories, some of which overlap."""
    sequence = ModeSequence(tuple(modes(0.9, times=4)), walk, np.ones(3))
    starts = sequence.states(sequence.paths(9))
    refined = refine(starts, sequence.prior, sequence.likelihood).without_duplicates()
    return sequence, refined, laplace_weights(refined)


@pytest.mark.parametrize('adapt', SUBSETS, ids='-'.join)
@pytest.mark.parametrize('velocity', [False, True])
def test_gradient_against_differences(modes, adapt, velocity):
    dynamics = LinearGaussianDynamics.random_walk([1.0, 2.0])
    if velocity:
        dynamics = LinearGaussianDynamics.constant_velocity([1.0, 2.0], 1.0)
    sequence = ModeSequence(tuple(modes(0.9, times=3)), dynamics, np.ones(2))
    found = refine(sequence.states(sequence.paths(3)), sequence.prior, sequence.likelihood)
    weights = laplace_weights(found)
    rng = np.random.default_rng(0)
    noise = antithetic(rng, 3, 4, found.states[0].size)
    objective = FreeEnergy(
        weights, found.states, found.factors, sequence.prior, sequence.likelihood, adapt,
        -np.inf, np.inf, noise,
    )  # fmt: skip
    x = 0.1 * rng.normal(size=objective.parameters)
    _, gradient = objective(x)
    directions = rng.normal(size=(20, len(x)))
    numeric = [(objective(x + 1e-5 * v)[0] - objective(x - 1e-5 * v)[0]) / 2e-5 for v in directions]
    np.testing.assert_allclose(directions @ gradient, numeric, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize('adapt', SUBSETS, ids='-'.join)
def test_descent_never_ends_above_where_it_began(problem, adapt):
    sequence, refined, weights = problem
    found = minimise_free_energy(
        weights, refined.states, refined.factors, sequence.prior, sequence.likelihood,
        adapt=adapt, samples=32,
    )  # fmt: skip
    assert (np.diff(found.free_energy) <= 0).all()
    assert found.weights.sum() == pytest.approx(1.0)
    if 'weights' not in adapt:
        np.testing.assert_allclose(found.weights, weights)
    if 'means' not in adapt:
        np.testing.assert_array_equal(found.states, refined.states)
    if 'inflation' not in adapt:
        np.testing.assert_array_equal(found.inflation, 1.0)


def test_free_energy_is_an_upper_bound_and_the_error_bar_is_honest(problem, walk, modes, exact):
    sequence, refined, weights = problem
    evidence, _ = exact(modes(0.9, times=4), walk, np.ones(3))
    values = []
    for seed in range(30):
        found = minimise_free_energy(
            weights, refined.states, refined.factors, sequence.prior, sequence.likelihood,
            samples=64, seed=seed, max_iterations=0,
        )  # fmt: skip
        values.append(found.fresh)
    values = np.array(values)
    assert values[:, 0].mean() > -evidence
    assert values[:, 1].mean() == pytest.approx(values[:, 0].std(ddof=1), rel=0.5)


def test_one_gaussian_is_found_exactly(modes, walk):
    sequence = ModeSequence(tuple(modes(0.0, k=1)), walk, np.ones(4))
    refined = refine(sequence.states(sequence.paths(1)), sequence.prior, sequence.likelihood)
    moved = refined.states + 0.3
    found = minimise_free_energy(
        np.ones(1), moved, refined.factors, sequence.prior, sequence.likelihood,
        max_iterations=50, tolerance=1e-12,
    )  # fmt: skip
    np.testing.assert_allclose(found.states, refined.states, atol=1e-4)
    assert found.inflation[0] == pytest.approx(1.0, abs=1e-4)
    assert found.fresh[1] < 1e-6


def test_the_same_seed_gives_the_same_numbers(problem):
    sequence, refined, weights = problem
    one, same, other = (
        minimise_free_energy(
            weights, refined.states, refined.factors, sequence.prior, sequence.likelihood, seed=s
        )
        for s in (0, 0, 1)
    )
    np.testing.assert_array_equal(one.states, same.states)
    np.testing.assert_array_equal(one.free_energy, same.free_energy)
    assert one.fresh == same.fresh
    assert one.fresh != other.fresh


def test_means_stay_within_limits(problem):
    sequence, refined, weights = problem
    found = minimise_free_energy(
        weights, np.clip(refined.states, -0.2, 0.2), refined.factors, sequence.prior,
        sequence.likelihood, low=-0.2, high=0.2, samples=16,
    )  # fmt: skip
    assert np.abs(found.states).max() <= 0.2


def test_weights_by_mass(problem):
    _, refined, weights = problem
    ratio = weights / np.exp(-refined.energies)
    volume = np.exp([-0.5 * factor.log_determinant for factor in refined.factors])
    np.testing.assert_allclose(ratio / ratio[0], volume / volume[0])


def test_settings_are_checked(problem):
    sequence, refined, weights = problem
    arguments = (weights, refined.states, refined.factors, sequence.prior, sequence.likelihood)
    with pytest.raises(ValueError, match='even number'):
        minimise_free_energy(*arguments, samples=3)
