"""Reduction of mixtures: moments are kept, little is lost, close components are merged."""

import numpy as np
import pytest

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.gaussian_pairs import (
    pair_distances,
    pair_log_densities,
    pair_mixture_log_determinants,
)
from hmt_ros.inference.reduction import (
    assignment,
    clustered,
    gaussian_divergences,
    merged,
    merged_if_close,
    merged_pairwise,
    reduced,
)


def random_mixture(rng, components, dimension, spread=2.0):
    factors = rng.normal(size=(components, dimension, 2 * dimension)) * 0.4
    return GaussianMixture(
        rng.dirichlet(np.ones(components)),
        spread * rng.normal(size=(components, dimension)),
        factors @ np.swapaxes(factors, 1, 2),
    )


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_divergences_between_gaussians(rng):
    a, b = random_mixture(rng, 3, 2), random_mixture(rng, 2, 2)
    found = gaussian_divergences(a, b)
    for i in range(3):
        for j in range(2):
            inverse = np.linalg.inv(b.covariances[j])
            offset = a.means[i] - b.means[j]
            ratio = np.linalg.det(b.covariances[j]) / np.linalg.det(a.covariances[i])
            expected = np.trace(inverse @ a.covariances[i]) + offset @ inverse @ offset - 2
            assert found[i, j] == pytest.approx(0.5 * (expected + np.log(ratio)))


def test_refinement_lowers_a_bound_of_the_divergence(rng):
    large = random_mixture(rng, 25, 4)
    small = large[:5].normalised()
    bound, share = assignment(large, small)
    bounds = [bound]
    for _ in range(8):
        small = merged(large, share)
        bound, share = assignment(large, small)
        bounds.append(bound)
    assert np.diff(bounds).max() < 1e-10
    assert bounds[-1] < bounds[0]
    points = large.sample(20_000, rng)
    divergence = (large.log_density(points) - small.log_density(points)).mean()
    assert divergence < bounds[-1]


@pytest.mark.parametrize('seed', range(4))
def test_reduction_keeps_moments_and_little_is_lost(seed):
    rng = np.random.default_rng(seed)
    large = random_mixture(rng, 25, 3)
    small = reduced(large, 5)
    assert len(small) == 5
    np.testing.assert_allclose(small.mean(), large.mean(), atol=1e-6)
    np.testing.assert_allclose(small.covariance(), large.covariance(), atol=1e-6)
    points = large.sample(20_000, rng)
    lost = [(large.log_density(points) - q.log_density(points)).mean()
            for q in (small, clustered(large, 5), merged_pairwise(large, 1))]  # fmt: skip
    assert lost[0] < lost[1] + 0.01
    assert lost[0] < 0.6 * lost[2]


def test_components_that_are_few_are_kept(rng):
    mixture = random_mixture(rng, 3, 2)
    assert reduced(mixture, 3) == mixture.normalised()


@pytest.mark.parametrize(
    'reduce',
    [
        lambda mixture: merged(mixture, np.eye(5)[np.arange(12) % 5]),
        lambda mixture: merged_pairwise(mixture, 3),
        lambda mixture: merged_if_close(mixture, 3.0),
    ],
)
def test_moments_stay(reduce, rng):
    large = random_mixture(rng, 12, 3)
    small = reduce(large)
    assert len(small) < 12
    np.testing.assert_allclose(small.weights.sum(), 1.0)
    np.testing.assert_allclose(small.mean(), large.mean(), atol=1e-12)
    np.testing.assert_allclose(small.covariance(), large.covariance(), atol=1e-12)


def test_only_close_components_are_merged():
    mixture = GaussianMixture(
        [0.2, 0.3, 0.1, 0.4], [[0.0], [1.0], [9.0], [0.4]], np.ones((4, 1, 1))
    )
    found = merged_if_close(mixture, 2.0)
    np.testing.assert_allclose(found.weights, [0.9, 0.1])
    np.testing.assert_allclose(found.means[:, 0], [0.46 / 0.9, 9.0])
    assert merged_if_close(mixture, 0.1) == mixture


def test_pairs_equal_the_written_out_formulas(rng):
    a, b = random_mixture(rng, 7, 5), random_mixture(rng, 3, 5)
    pairs = np.indices((7, 3)).reshape(2, -1).T
    found = pair_log_densities(a.means, a.covariances, b.means, b.covariances, pairs)
    for value, (i, j) in zip(found, pairs):
        one = GaussianMixture([1.0], a.means[[i]], a.covariances[[i]] + b.covariances[[j]])
        assert value == pytest.approx(one.log_density(b.means[[j]])[0], abs=1e-10)
    scales = rng.uniform(0.5, 2.0, 7)
    found = pair_distances(a.means, a.covariances, scales, pairs)
    for value, (i, j) in zip(found, pairs):
        offset = a.means[i] - a.means[j]
        spread = scales[i] * a.covariances[i] + scales[j] * a.covariances[j]
        assert value == pytest.approx(offset @ np.linalg.solve(spread, offset), abs=1e-10)


def test_determinants_of_pairs_are_those_of_their_moments(rng):
    for count in (2, 30):
        mixture = random_mixture(rng, count, 5)
        pairs = np.stack(np.triu_indices(count, 1), axis=1)
        found = pair_mixture_log_determinants(
            mixture.means, mixture.covariances, mixture.weights, pairs
        )
        wanted = [np.linalg.slogdet(mixture[pair].covariance())[1] for pair in pairs]
        np.testing.assert_allclose(found, wanted, atol=1e-12)
