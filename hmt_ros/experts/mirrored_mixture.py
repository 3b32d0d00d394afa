"""Expectation maximisation of Gaussian mixtures over angles and their mirror images.

    p(a) = w_0 N(a; m_0, S_0) + (1 - w_0) sum_k w_k/2 [N(a; m_k, S_k) + N(Ra; m_k, S_k)]

A sample a and its mirror image Ra are one sample that may be seen either way round: K components
stand for 2 K, and the density of a pose is that of its mirror image. Component 0 is given. The
covariances have an inverse Wishart prior of v samples with the scatter B; every iteration raises

    F = sum_n s_n log p(a_n) - v/2 sum_k [log |S_k| + tr(B S_k^-1)]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.mixture import GaussianMixture

# A component with less than this share of one sample keeps its mean and covariance.
LEAST_SAMPLES = 1e-3


@dataclass(frozen=True, eq=False)
class MirroredSamples:
    """Samples that may be seen either way round.

    Attributes:
        angles, images: (N, n) samples and their mirror images, rad.
        weights: (N,) number of independent samples that each stands for.
    """

    angles: Array
    images: Array
    weights: Array

    @property
    def both(self) -> Array:
        """Samples, then their mirror images, (2 N, n)."""
        return np.concatenate([self.angles, self.images])

    def scatter(self) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) of samples and mirror images together."""
        points, weights = self.both, np.tile(self.weights, 2) / (2.0 * self.weights.sum())
        mean = weights @ points
        offset = points - mean
        return mean, (offset * weights[:, None]).T @ offset


@dataclass(frozen=True, eq=False)
class CovariancePrior:
    """The inverse Wishart prior of the covariances.

    Attributes:
        samples: v.
        scatter: (n, n) B, rad^2.
    """

    samples: float
    scatter: Array

    def log_density(self, covariances: Array) -> float:
        """Of covariances (K, n, n), up to a constant."""
        trace = np.trace(np.linalg.solve(covariances, self.scatter), axis1=1, axis2=2)
        return float(-0.5 * self.samples * (np.linalg.slogdet(covariances)[1] + trace).sum())


def mirrored_log_densities(mixture: GaussianMixture, angles: Array, images: Array) -> Array:
    """Logarithms (N, 2 K + 1) of the terms of p: the components, of the images, the broad one.

    Args:
        mixture: component 0, then K components.
        angles, images: (N, n).
    """
    with np.errstate(divide='ignore'):
        log_weights = np.log(mixture.weights)
    halves = log_weights[1:] - np.log(2.0)
    own = mixture[1:]
    return np.concatenate(
        [
            own.component_log_densities(angles) + halves,
            own.component_log_densities(images) + halves,
            mixture[:1].component_log_densities(angles) + log_weights[:1],
        ],
        axis=1,
    )


def seeds_of(samples: MirroredSamples, count: int, rng: np.random.Generator) -> Array:
    """Samples (K, n) that are far from each other, drawn as k-means++ does.

    Args:
        samples: to draw from.
        count: K.
        rng: source of randomness.
    """
    scale = np.sqrt(np.maximum(np.diagonal(samples.scatter()[1]), 1e-12))
    chosen: list[Array] = []
    nearest = np.ones(len(samples.angles))
    for _ in range(count):
        weights = samples.weights * nearest
        total = weights.sum()
        share = weights / total if total > 0 else samples.weights / samples.weights.sum()
        chosen.append(samples.angles[rng.choice(len(share), p=share)])
        away = [(((x - chosen[-1]) / scale) ** 2).sum(1) for x in (samples.angles, samples.images)]
        away = np.minimum(*away)
        nearest = away if len(chosen) == 1 else np.minimum(nearest, away)
    return np.array(chosen)


def fitted_mixture(
    samples: MirroredSamples,
    start: GaussianMixture,
    prior: CovariancePrior,
    iterations: int = 100,
    tolerance: float = 1e-3,
) -> tuple[GaussianMixture, list[float]]:
    """The mixture that EM reaches.

    Args:
        samples: N samples.
        start: component 0, which stays as it is, then K components; weights sum to 1.
        prior: of the covariances.
        iterations: maximum number.
        tolerance: gain of an iteration at which the iterations end, nats per sample.

    Returns:
        The mixture, and F before each iteration.
    """
    points, k = samples.both, len(start) - 1
    broad, mixture = start[:1], start
    bounds: list[float] = []
    for _ in range(iterations):
        log = mirrored_log_densities(mixture, samples.angles, samples.images)
        total = logsumexp(log, axis=1)
        bound = samples.weights @ total + prior.log_density(mixture.covariances[1:])
        if bounds and bound - bounds[-1] < tolerance * samples.weights.sum():
            return mixture, [*bounds, float(bound)]
        bounds.append(float(bound))
        shares = np.exp(log - total[:, None]) * samples.weights[:, None]
        each = np.concatenate([shares[:, :k], shares[:, k : 2 * k]])
        filled = each.sum(0)
        means, covariances = mixture.means[1:].copy(), mixture.covariances[1:].copy()
        for i in np.flatnonzero(filled > LEAST_SAMPLES):
            means[i] = each[:, i] @ points / filled[i]
            offset = points - means[i]
            scatter = (offset * each[:, i : i + 1]).T @ offset
            covariances[i] = (scatter + prior.samples * prior.scatter) / (filled[i] + prior.samples)
        weights = (1.0 - broad.weights[0]) * filled / filled.sum()
        mixture = GaussianMixture(
            np.concatenate([broad.weights, weights]),
            np.concatenate([broad.means, means]),
            np.concatenate([broad.covariances, covariances]),
        )
    return mixture, bounds
