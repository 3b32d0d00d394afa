"""Levels of highest-density regions against closed forms, a grid and their distribution."""

import numpy as np
import pytest
from scipy.stats import chi2

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.calibration import (
    calibration_error,
    coverage,
    levels_of,
    marginal_log_densities,
    stratified_samples,
)


def levels_under(mixture, points, samples):
    return levels_of(mixture.log_density(points), mixture.log_density(samples))


def random_mixture(rng, k, d, spread=2.0):
    root = rng.normal(size=(k, d, d))
    return GaussianMixture(
        rng.dirichlet(np.ones(k)),
        spread * rng.normal(size=(k, d)),
        root @ root.transpose(0, 2, 1) + 0.3 * np.eye(d),
    )


@pytest.mark.parametrize('d', [1, 3, 39])
def test_level_of_a_gaussian_is_the_chi_square_of_its_distance(d):
    rng = np.random.default_rng(d)
    mixture = random_mixture(rng, 1, d)
    points = mixture.sample(20, rng)
    levels = levels_under(mixture, points, stratified_samples(mixture, 20_000, rng))
    offset = points - mixture.means[0]
    distance = (offset * np.linalg.solve(mixture.covariances[0], offset.T).T).sum(1)
    assert np.allclose(levels, chi2(d).cdf(distance), atol=0.015)


def test_level_of_a_mixture_agrees_with_quadrature():
    mixture = GaussianMixture(
        np.array([0.7, 0.3]), np.array([[0.0], [4.0]]), np.array([[[1.0]], [[0.04]]])
    )
    grid = np.linspace(-8, 12, 40_001)
    density = np.exp(mixture.log_density(grid[:, None]))
    points = np.array([[0.0], [1.2], [-1.5], [3.9], [4.5], [2.5]])
    at_points = np.exp(mixture.log_density(points))
    wanted = [density[density > p].sum() * (grid[1] - grid[0]) for p in at_points]
    samples = stratified_samples(mixture, 40_000, np.random.default_rng(0))
    levels = levels_under(mixture, points, samples)
    # The narrow mode is the densest, so its level is low despite its smaller weight.
    assert wanted[3] < 0.3
    assert np.allclose(levels, wanted, atol=0.01)


def test_values_drawn_from_their_densities_have_uniform_levels():
    rng = np.random.default_rng(5)
    levels = []
    for _ in range(1500):
        mixture = random_mixture(rng, int(rng.integers(1, 5)), 3)
        level = levels_under(mixture, mixture.sample(1, rng), stratified_samples(mixture, 100, rng))
        levels.append(level[0])
    error = np.sqrt(0.25 / len(levels))
    assert abs(coverage(levels, 0.5) - 0.5) < 3 * error
    assert abs(coverage(levels, 0.9) - 0.9) < 3 * 0.6 * error
    assert calibration_error(levels) < 2 * error


def test_calibration_error_of_too_narrow_and_too_wide_densities():
    assert calibration_error(np.ones(7)) == pytest.approx(0.5)
    assert calibration_error(np.zeros(7)) == pytest.approx(0.5)
    assert calibration_error((np.arange(1000) + 0.5) / 1000) < 1e-9


def test_stratified_samples_have_the_moments_and_weights_of_the_mixture():
    rng = np.random.default_rng(2)
    mixture = GaussianMixture(
        np.array([0.6, 0.1, 0.3]),
        np.array([[0.0, 0], [50, 0], [0, 50]]),
        np.tile(np.eye(2), (3, 1, 1)),
    )
    samples = stratified_samples(mixture, 1000, rng)
    assert samples.shape == (1000, 2)
    nearest = np.linalg.norm(samples[:, None] - mixture.means, axis=2).argmin(1)
    assert np.allclose(np.bincount(nearest), [600, 100, 300], atol=1)
    assert np.allclose(np.cov(samples.T), mixture.covariance(), rtol=0.02)


def test_marginals_are_those_of_the_sub_vectors():
    rng = np.random.default_rng(4)
    mixture = random_mixture(rng, 3, 6)
    points = rng.normal(size=(5, 6))
    result = marginal_log_densities(mixture, points, 3)
    for group in range(2):
        own = slice(3 * group, 3 * group + 3)
        part = GaussianMixture(
            mixture.weights, mixture.means[:, own], mixture.covariances[:, own, own]
        )
        assert np.allclose(result[:, group], part.log_density(points[:, own]), rtol=1e-10)
    with pytest.raises(ValueError, match='6 variables'):
        marginal_log_densities(mixture, points, 4)


def test_levels_count_denser_samples():
    at_samples = np.array([[0.0, 5.0], [1.0, 6.0], [2.0, 7.0], [3.0, 8.0]])
    assert levels_of(np.array([[1.5, 9.0]]), at_samples).tolist() == [[0.5, 0.0]]
