"""Where hypotheses come from: spherical, covariance-scaled, kinematic jump sampling (KJS 3, 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body

Array = NDArray[np.float64]

PROPOSALS = ('kjs', 'css', 'ss')


def spherical_samples(
    body: Body, means: Array, covariances: Array, count: int, scale: float, rng: np.random.Generator
) -> Array:
    """Isotropic noise around each mean, of the volume that its covariance has; (K, count, d).

    The radius is the geometric mean of the axes of the ellipsoid, |S|^(1/2d). Samples that leave
    the limits are projected back.

    Args:
        body: with the limits.
        means, covariances: (K, d), (K, d, d).
        count: samples a mean.
        scale: factor on the radius; 0: Cauchy tails of scale 1.
        rng: source of randomness.
    """
    d = means.shape[1]
    radius = np.exp(np.linalg.slogdet(covariances)[1] / (2 * d))
    noise = _noise((len(means), count, d), scale, rng)
    samples: Array = np.clip(means[:, None] + radius[:, None, None] * noise, body.lower, body.upper)
    return samples


def covariance_scaled_samples(
    body: Body, means: Array, covariances: Array, count: int, scale: float, rng: np.random.Generator
) -> Array:
    """Noise with the covariance of each mean, stretched; (K, count, d). Arguments as above."""
    factors = np.linalg.cholesky(covariances)
    noise = _noise((len(means), count, means.shape[1]), scale, rng)
    samples: Array = np.clip(
        means[:, None] + np.einsum('kij,knj->kni', factors, noise), body.lower, body.upper
    )
    return samples


def _noise(shape: tuple[int, ...], scale: float, rng: np.random.Generator) -> Array:
    """Gaussian noise times a scale, or multivariate Cauchy noise where the scale is 0."""
    noise = rng.standard_normal(shape)
    if scale > 0:
        return scale * noise
    heavy = np.sqrt(rng.chisquare(1, size=(*shape[:-1], 1)))
    return noise / np.maximum(heavy, 1e-3)
