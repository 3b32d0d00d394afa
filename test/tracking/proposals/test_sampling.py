"""Samplers against moments, quantiles and eigenvectors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from hmt_ros.tracking.proposals.sampling import (
    covariance_scaled_samples,
    spherical_samples,
)

N = 40_000
SAMPLERS = (spherical_samples, covariance_scaled_samples)


@pytest.fixture(scope='module')
def free(human32):
    """The body without limits."""
    s = human32.skeleton
    far = np.full(s.dimension, 1e9)
    return replace(human32, skeleton=replace(s, lower=-far, upper=far))


@pytest.mark.parametrize('scale', [1.0, 4.0])
def test_covariance_scaled_samples_have_the_covariance(free, modes, scale):
    means, covariances = modes
    samples = covariance_scaled_samples(free, *modes, N, scale, np.random.default_rng(1))
    assert samples.shape == (2, N, free.dimension)
    for k in range(2):
        wanted = scale**2 * covariances[k]
        deviations = np.sqrt(np.diag(wanted))
        error = (np.cov(samples[k].T) - wanted) / np.outer(deviations, deviations)
        assert np.abs(error).max() < 5.5 * np.sqrt(2 / N)
        shift = (samples[k].mean(0) - means[k]) / deviations
        assert np.abs(shift).max() < 5 / np.sqrt(N)


@pytest.mark.parametrize('scale', [1.0, 8.0])
def test_spherical_samples_have_the_volume_of_the_covariance(free, modes, scale):
    means, covariances = modes
    samples = spherical_samples(free, *modes, N, scale, np.random.default_rng(2))
    for k in range(2):
        # The geometric mean of the axes, from the eigenvalues.
        radius = np.exp(0.5 * np.log(np.linalg.eigvalsh(covariances[k])).mean())
        found = np.cov(samples[k].T) / (scale * radius) ** 2
        assert np.abs(found - np.eye(free.dimension)).max() < 5.5 * np.sqrt(2 / N)
        assert np.abs(samples[k].mean(0) - means[k]).max() < 5 * scale * radius / np.sqrt(N)


def test_cauchy_tails_of_covariance_scaled_samples(free, modes):
    """Standard Cauchy along any direction; the squared Mahalanobis distance is d F(d, 1)."""
    means, covariances = modes
    samples = covariance_scaled_samples(free, *modes, N, 0.0, np.random.default_rng(3))
    d = free.dimension
    for k in range(2):
        white = np.linalg.solve(np.linalg.cholesky(covariances[k]), (samples[k] - means[k]).T)
        for line in (white[0], white[-1], white[:4].sum(0) / 2):
            assert stats.kstest(line, stats.cauchy.cdf).statistic < 1.95 / np.sqrt(N)
        square = (white**2).sum(0) / d
        # The tail is cut where noise is divided by 1e-3 or less, which is once in 1250.
        assert stats.kstest(square, stats.f(d, 1).cdf).statistic < 1.95 / np.sqrt(N) + 1e-3


def test_cauchy_tails_of_spherical_samples(free, modes):
    means, covariances = modes
    samples = spherical_samples(free, *modes, N, 0.0, np.random.default_rng(4))
    for k in range(2):
        radius = np.linalg.det(covariances[k] / 1e-4) ** (0.5 / free.dimension) * 1e-2
        noise = (samples[k] - means[k]) / radius
        for j in (0, 7, 31):
            assert stats.kstest(noise[:, j], stats.cauchy.cdf).statistic < 1.95 / np.sqrt(N)


@pytest.mark.parametrize('draw', SAMPLERS)
@pytest.mark.parametrize('scale', [0.0, 4.0])
def test_samples_that_leave_the_limits_are_projected_back(human32, free, modes, draw, scale):
    means, covariances = modes
    wide = 400 * covariances
    samples = draw(human32, means, wide, 500, scale, np.random.default_rng(5))
    loose = draw(free, means, wide, 500, scale, np.random.default_rng(5))
    nearest = np.minimum(np.maximum(loose, human32.lower), human32.upper)
    assert np.array_equal(samples, nearest)
    assert (samples == human32.lower).any()
    assert (samples == human32.upper).any()


@pytest.mark.parametrize('draw', SAMPLERS)
def test_the_same_seed_gives_the_same_samples(free, modes, draw):
    first, again, other = (draw(free, *modes, 5, 2.0, np.random.default_rng(s)) for s in (6, 6, 7))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)
