from __future__ import annotations

import numpy as np
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from hmt_learning.training.prior_learning import (
    CovariancePrior,
    MirroredSamples,
    fitted_mixture,
    mirrored_log_densities,
    seeds_of,
)
from hmt_ros.inference.mixture import GaussianMixture

FLIP = np.array([-1.0, 1.0, 1.0])  # the mirror image changes the sign of the first angle


def samples(count: int = 400, seed: int = 0) -> MirroredSamples:
    """Two clusters with a ratio of 3:1, each in both mirror images."""
    rng = np.random.default_rng(seed)
    first = rng.random(count) < 0.75
    means = np.where(first[:, None], [2.0, 0.0, 0.0], [0.5, 4.0, -1.0])
    angles = means + np.where(first[:, None], 0.3, 0.5) * rng.normal(size=(count, 3))
    angles[rng.random(count) < 0.5] *= FLIP
    return MirroredSamples(angles, angles * FLIP, np.ones(count))


def start_of(data: MirroredSamples, count: int, broad: float = 0.05) -> GaussianMixture:
    means = seeds_of(data, count, np.random.default_rng(1))
    return GaussianMixture(
        np.array([broad, *[(1 - broad) / count] * count]),
        np.concatenate([np.zeros((1, 3)), means]),
        np.concatenate([9.0 * np.eye(3)[None], np.repeat(np.eye(3)[None], count, axis=0)]),
    )


def test_clusters_are_found_once_for_both_sides():
    data = samples()
    prior = CovariancePrior(2.0, 0.1 * np.eye(3))
    found, _ = fitted_mixture(data, start_of(data, 2), prior)
    order = np.argsort(found.means[1:, 1])
    means, weights = found.means[1:][order], found.weights[1:][order]
    assert np.allclose(np.abs(means), [[2.0, 0.0, 0.0], [0.5, 4.0, 1.0]], atol=0.15)
    assert np.allclose(weights, [0.95 * 0.75, 0.95 * 0.25], atol=0.05)
    deviations = np.sqrt(np.diagonal(found.covariances[1:][order], axis1=1, axis2=2))
    assert np.allclose(deviations, [[0.3] * 3, [0.5] * 3], atol=0.1)
    # The broad component is unchanged.
    assert found.weights[0] == 0.05
    assert np.array_equal(found.covariances[0], 9.0 * np.eye(3))


def test_every_iteration_raises_the_bound():
    data = samples(150, 3)
    weighted = MirroredSamples(data.angles, data.images, np.linspace(0.2, 1.8, 150))
    prior = CovariancePrior(5.0, 0.2 * np.eye(3))
    mixture, bounds = fitted_mixture(weighted, start_of(weighted, 4), prior, 40, 0.0)
    assert len(bounds) > 5
    assert (np.diff(bounds) > -1e-9).all()
    log = mirrored_log_densities(mixture, weighted.angles, weighted.images)
    total = weighted.weights @ logsumexp(log, axis=1) + prior.log_density(mixture.covariances[1:])
    assert total >= bounds[-1] - 1e-9


def test_densities_are_those_of_either_side():
    data = samples(20, 4)
    mixture = start_of(data, 2)
    found = mirrored_log_densities(mixture, data.angles, data.images)
    parts = [multivariate_normal(m, s) for m, s in zip(mixture.means, mixture.covariances)]
    half = np.log(0.5 * mixture.weights[1:])
    wanted = [parts[i].logpdf(data.angles) + half[i - 1] for i in (1, 2)]
    wanted += [parts[i].logpdf(data.angles * FLIP) + half[i - 1] for i in (1, 2)]
    wanted += [parts[0].logpdf(data.angles) + np.log(0.05)]
    assert np.allclose(found, np.transpose(wanted))
