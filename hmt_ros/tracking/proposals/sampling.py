"""Spherical and covariance-scaled sampling (KJS 3 and 5).

SS      x ~ N(m, s^2 r^2 I),  r = |S|^(1/2d)
CSS     x ~ N(m, s^2 S)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import cholesky, log_determinant
from hmt_ros.inference.random_numbers import standard_normals
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.optimisation import Search


def spherical_samples(
    body: Body, means: Array, covariances: Array, count: int, scale: float, rng: np.random.Generator
) -> Array:
    """Samples (K, count, d) with isotropic noise that has the volume of each covariance.

    The radius is the geometric mean of the axes of the ellipsoid, |S|^(1/2d). Samples are clipped
    to the limits.

    Args:
        body: body with the limits.
        means, covariances: means (K, d) and covariances (K, d, d) of the modes.
        count: number of samples per mean.
        scale: factor on the radius; 0 selects Cauchy noise of scale 1.
        rng: source of randomness.
    """
    d = means.shape[1]
    radius = elementary.exp(log_determinant(covariances) / (2 * d))
    noise = _noise((len(means), count, d), scale, rng)
    samples: Array = np.clip(means[:, None] + radius[:, None, None] * noise, body.lower, body.upper)
    return samples


def covariance_scaled_samples(
    body: Body, means: Array, covariances: Array, count: int, scale: float, rng: np.random.Generator
) -> Array:
    """Samples (K, count, d) with the scaled covariance of each mode; see `spherical_samples`."""
    factors = cholesky(covariances)
    noise = _noise((len(means), count, means.shape[1]), scale, rng)
    samples: Array = np.clip(
        means[:, None] + np.einsum('kij,knj->kni', factors, noise), body.lower, body.upper
    )
    return samples


def _noise(shape: tuple[int, ...], scale: float, rng: np.random.Generator) -> Array:
    """Gaussian noise times a scale, or multivariate Cauchy noise if the scale is 0."""
    noise = standard_normals(rng, shape)
    if scale > 0:
        return scale * noise
    heavy = np.abs(standard_normals(rng, (*shape[:-1], 1)))
    return noise / np.maximum(heavy, np.finfo(np.float64).eps)


def covariance_scaled_poses(
    search: Search, sources: Hypotheses, rng: np.random.Generator
) -> Hypotheses:
    """Covariance-scaled samples around the predictions."""
    return _sampled(covariance_scaled_samples, search, sources, rng)


def spherical_poses(search: Search, sources: Hypotheses, rng: np.random.Generator) -> Hypotheses:
    """Spherical samples around the predictions, with the volume of the covariances."""
    return _sampled(spherical_samples, search, sources, rng)


def _sampled(
    draw: Callable[[Body, Array, Array, int, float, np.random.Generator], Array],
    search: Search,
    sources: Hypotheses,
    rng: np.random.Generator,
) -> Hypotheses:
    """Selects representatives of the samples and of the optima of the predictions."""
    posterior, k = search.posterior, len(sources)
    s, body = posterior.settings, posterior.body
    each = max(s.samples // k, 1)
    drawn = draw(body, sources.expected, search.states.searched, each, s.sample_scale, rng)
    poses = np.concatenate([search.base.x, drawn.reshape(-1, body.dimension)])
    rows = np.concatenate([np.arange(k), np.repeat(np.arange(k), each)])
    kept = search.best(poses, posterior.of_image(search.observation).values(poses))
    still = np.zeros((len(kept), body.dimension), dtype=np.bool_)
    return sources.proposed(rows[kept], poses[kept], still)
