"""Gaussian mixtures, compared with scipy, quadrature and their moments."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate
from scipy.stats import multivariate_normal

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.reduction import merged_pairwise


def random_mixture(k: int, d: int, seed: int, total: float = 1.0) -> GaussianMixture:
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(k, d, d))
    covariances = factors @ factors.swapaxes(1, 2) + 0.1 * np.eye(d)
    weights = rng.uniform(0.1, 1, k)
    return GaussianMixture(total * weights / weights.sum(), rng.normal(0, 3, (k, d)), covariances)


@pytest.mark.parametrize(('k', 'd'), [(1, 1), (3, 1), (2, 3), (5, 7)])
def test_log_density_equals_scipy(k, d):
    mixture = random_mixture(k, d, 0, total=2.5)
    x = np.random.default_rng(1).normal(0, 3, (50, d))
    components = np.stack(
        [
            multivariate_normal(m, s).logpdf(x).reshape(-1)
            for m, s in zip(mixture.means, mixture.covariances)
        ],
        axis=1,
    )
    np.testing.assert_allclose(mixture.component_log_densities(x), components, rtol=1e-9)
    np.testing.assert_allclose(np.exp(mixture.log_determinants), np.linalg.det(mixture.covariances))
    expected = np.log(np.exp(components) @ mixture.weights)
    np.testing.assert_allclose(mixture.log_density(x), expected, rtol=1e-9)


def test_log_density_far_away_is_finite():
    mixture = random_mixture(3, 2, 2)
    value = mixture.log_density(np.array([[1e5, -1e5]]))
    assert np.isfinite(value).all()
    assert value[0] < -1e6


def test_density_integrates_to_the_total_weight():
    mixture = random_mixture(4, 1, 3, total=1.7)
    area, _ = integrate.quad(
        lambda x: float(np.exp(mixture.log_density([[x]]))[0]), -60, 60, limit=500
    )
    assert area == pytest.approx(1.7, abs=1e-6)


def test_density_in_the_plane_integrates_to_one():
    mixture = random_mixture(3, 2, 4)
    grid = np.linspace(-25, 25, 501)
    x = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    cell = (grid[1] - grid[0]) ** 2
    cell = (grid[1] - grid[0]) ** 2
    assert np.exp(mixture.log_density(x)).sum() * cell == pytest.approx(1, abs=1e-6)


def test_a_component_of_weight_zero_adds_nothing():
    mixture = random_mixture(2, 2, 5)
    more = GaussianMixture(
        [*mixture.weights, 0.0],
        np.concatenate([mixture.means, [[0, 0]]]),
        np.concatenate([mixture.covariances, np.eye(2)[None]]),
    )
    x = np.random.default_rng(0).normal(size=(10, 2))
    np.testing.assert_allclose(more.log_density(x), mixture.log_density(x), rtol=1e-12)


def test_moments_of_samples_equal_those_of_the_mixture():
    mixture = random_mixture(3, 2, 6, total=0.3)
    n = 200_000
    x = mixture.sample(n, np.random.default_rng(7))
    assert x.shape == (n, 2)
    scale = np.sqrt(np.diagonal(mixture.covariance()))
    assert (np.abs(x.mean(0) - mixture.mean()) < 5 * scale / np.sqrt(n)).all()
    np.testing.assert_allclose(
        np.cov(x.T), mixture.covariance(), atol=0.02 * scale.max() ** 2, rtol=0.02
    )


def test_samples_follow_their_seed():
    mixture = random_mixture(3, 2, 8)
    one, same, other = (mixture.sample(5, np.random.default_rng(s)) for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_samples_have_the_density():
    """Compares fractions of samples in cells with the integrated density."""
    mixture = random_mixture(3, 1, 9)
    x = mixture.sample(100_000, np.random.default_rng(3))[:, 0]
    edges = np.linspace(-12, 12, 25)
    seen = np.histogram(x, edges)[0] / len(x)
    for low, high, fraction in zip(edges, edges[1:], seen):
        area, _ = integrate.quad(lambda v: float(np.exp(mixture.log_density([[v]]))[0]), low, high)
        assert abs(area - fraction) < 5 * np.sqrt(max(area, 1e-4) / len(x))


@given(
    k=st.integers(1, 8),
    keep=st.integers(1, 9),
    d=st.integers(1, 4),
    seed=st.integers(0, 2**32 - 1),
    total=st.floats(0.01, 10),
)
def test_reduction_keeps_mean_covariance_and_total_weight(k, keep, d, seed, total):
    mixture = random_mixture(k, d, seed, total)
    reduced = merged_pairwise(mixture, keep)
    assert len(reduced) == min(k, keep)
    assert reduced.weights.sum() == pytest.approx(total)
    scale = np.abs(mixture.covariance()).max()
    np.testing.assert_allclose(reduced.mean(), mixture.mean(), atol=1e-9)
    np.testing.assert_allclose(reduced.covariance(), mixture.covariance(), atol=1e-10 * scale)
    reduced.cholesky()


def test_reduction_merges_twins_first():
    mixture = GaussianMixture(
        [0.2, 0.5, 0.3], [[0.0], [10.0], [0.01]], np.array([[[1.0]], [[1.0]], [[1.0]]])
    )
    reduced = merged_pairwise(mixture, 2)
    np.testing.assert_allclose(np.sort(reduced.means[:, 0]), [0.006, 10.0])
    assert len(merged_pairwise(mixture, 3)) == len(merged_pairwise(mixture, 7)) == 3


def test_reduction_drops_components_of_weight_zero():
    mixture = GaussianMixture([0.5, 0.0, 0.5], [[0.0], [5.0], [9.0]], np.ones((3, 1, 1)))
    np.testing.assert_array_equal(merged_pairwise(mixture, 2).means, [[0.0], [9.0]])


def test_reduction_to_one_is_the_moment_match():
    mixture = random_mixture(6, 3, 10, total=2.0)
    one = merged_pairwise(mixture, 1)
    np.testing.assert_allclose(one.means[0], mixture.mean())
    np.testing.assert_allclose(one.covariances[0], mixture.covariance())
    assert one.weights[0] == pytest.approx(2.0)


def test_reduction_of_many_components_costs_little_divergence():
    rng = np.random.default_rng(11)
    centres = np.array([[-6.0, 0], [6, 0], [0, 7]])
    means = centres[rng.integers(0, 3, 60)] + rng.normal(0, 0.1, (60, 2))
    mixture = GaussianMixture(np.full(60, 1 / 60), means, np.tile(np.eye(2), (60, 1, 1)))
    reduced = merged_pairwise(mixture, 3)
    x = mixture.sample(2000, rng)
    assert np.mean(mixture.log_density(x) - reduced.log_density(x)) < 0.01


def test_normalised_sorted_and_parts():
    mixture = GaussianMixture([0.5, 2.0, 1.5], [[1.0], [2.0], [3.0]], np.ones((3, 1, 1)))
    np.testing.assert_allclose(mixture.normalised().weights, [0.125, 0.5, 0.375])
    np.testing.assert_array_equal(mixture.sorted().means[:, 0], [2, 3, 1])
    np.testing.assert_array_equal(mixture[1:].means[:, 0], [2, 3])
    np.testing.assert_array_equal(mixture[[2, 0]].weights, [1.5, 0.5])
    assert len(mixture[0]) == 1
    assert mixture == GaussianMixture(mixture.weights, mixture.means, mixture.covariances)
    assert mixture != mixture.normalised()


def test_equal_weights_keep_their_order_when_sorted():
    mixture = GaussianMixture([1.0, 1.0, 1.0], [[1.0], [2.0], [3.0]], np.ones((3, 1, 1)))
    np.testing.assert_array_equal(mixture.sorted().means[:, 0], [1, 2, 3])


def test_a_mixture_can_not_be_written_and_copies_its_arrays():
    weights = np.ones(1)
    mixture = GaussianMixture(weights, [[0.0]], [[[1.0]]])
    weights[0] = 5.0
    assert mixture.weights[0] == 1.0
    with pytest.raises(ValueError, match='read-only'):
        mixture.weights[0] = 2.0


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (([1.0], [0.0], [[[1.0]]]), 'means has 1 axes, wanted 2'),
        (([1.0], [[0.0]], [[1.0]]), 'covariances has 2 axes, wanted 3'),
        (([1.0, 1.0], [[0.0]], [[[1.0]]]), r'weights \(2,\), means \(1, 1\)'),
        (([1.0], [[0.0, 1.0]], [[[1.0]]]), 'do not fit'),
        (([-1.0], [[0.0]], [[[1.0]]]), 'weights must not be negative, saw -1'),
        (([np.nan], [[0.0]], [[[1.0]]]), 'weights has values that are not finite'),
        (([1.0], [[np.inf]], [[[1.0]]]), 'means has values that are not finite'),
    ],
)
def test_parts_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        GaussianMixture(*arguments)


def test_use_that_makes_no_sense_is_refused():
    mixture = random_mixture(2, 2, 12)
    with pytest.raises(ValueError, match=r'points have shape \(2,\), wanted \(N, 2\)'):
        mixture.log_density(np.zeros(2))
    with pytest.raises(ValueError, match=r'points have shape \(4, 3\), wanted \(N, 2\)'):
        mixture.log_density(np.zeros((4, 3)))
    with pytest.raises(ValueError, match='k must be at least 1, saw 0'):
        merged_pairwise(mixture, 0)
    indefinite = GaussianMixture([1.0, 1.0], np.zeros((2, 2)), [np.eye(2), np.diag([1.0, -1.0])])
    with pytest.raises(ValueError, match='component 1 is not positive definite'):
        indefinite.log_density(np.zeros((1, 2)))
    nothing = GaussianMixture([0.0], [[0.0]], [[[1.0]]])
    with pytest.raises(ValueError, match='total weight 0'):
        nothing.normalised()
