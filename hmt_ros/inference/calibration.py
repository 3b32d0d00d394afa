"""Calibration of densities, from the highest-density regions that contain the true values.

The level of a value x under a density p is the probability content of the smallest highest-density
region that contains x,

    level(x) = P(p(X) > p(x)),  X ~ p,

so that the highest-density region of probability q contains x if and only if level(x) <= q. If each
value is drawn from its density, the levels are uniform on [0, 1], whatever the densities. The share
of levels up to q is the coverage of the region of probability q, and should equal q. Best-of-N
errors alone reward miscalibrated densities, see Pierzchlewicz et al., "Multi-hypothesis 3D human
pose estimation metrics favor miscalibrated distributions" (2022).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import cholesky, inverse, product
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.inference.random_numbers import standard_normals


def levels_of(at_points: Array, at_samples: Array) -> Array:
    """Level of each point: the share of samples with a higher density than the point.

    Args:
        at_points: (N, ...) densities at the points, or any increasing function of the densities.
        at_samples: (S, ...) the same function at samples from the density; further axes are for
            further densities.
    """
    return np.asarray((at_samples[:, None] > at_points[None]).mean(0))


def stratified_samples(mixture: GaussianMixture, count: int, rng: np.random.Generator) -> Array:
    """Draw points (count, d); the number from each component is proportional to its weight."""
    cumulated = np.cumsum(mixture.normalised().weights)
    at = (np.arange(count) + rng.random()) / count
    owners = np.minimum(np.searchsorted(cumulated, at, side='right'), len(mixture) - 1)
    result = standard_normals(rng, (count, mixture.dimension))
    factors = mixture.cholesky()
    for k in range(len(mixture)):
        mine = owners == k
        result[mine] = product(result[mine], factors[k].T) + mixture.means[k]
    return result


def marginal_log_densities(mixture: GaussianMixture, points: ArrayLike, size: int) -> Array:
    """Marginal log densities (N, d / size) of groups of `size` variables at points (N, d).

    Raises:
        ValueError: the dimension is not a multiple of the size.
    """
    x = np.asarray(points, dtype=np.float64)
    d = mixture.dimension
    if size < 1 or d % size:
        raise ValueError(f'{d} variables can not be split into groups of {size}')
    groups = d // size
    k = len(mixture)
    blocks = mixture.covariances.reshape(k, groups, size, groups, size)
    own = np.arange(groups)
    factors = cholesky(blocks[:, own, :, own, :].transpose(1, 0, 2, 3))  # (K, G, s, s)
    whiteners = inverse(factors)
    offsets = x.reshape(1, -1, groups, size) - mixture.means.reshape(k, 1, groups, size)
    white = product(offsets.transpose(0, 2, 1, 3), whiteners.transpose(0, 1, 3, 2))  # (K, G, N, s)
    log_scale = elementary.log(np.diagonal(whiteners, axis1=2, axis2=3)).sum(2)
    with np.errstate(divide='ignore'):
        log_weights = elementary.log(mixture.weights)
    each = np.einsum('kgns,kgns->kgn', white, white)
    each *= -0.5
    each += (log_scale - 0.5 * size * elementary.log(2 * np.pi) + log_weights[:, None])[:, :, None]
    # scipy's logsumexp, without its overhead for axes and signs.
    top = each.max(0)
    each -= top
    elementary.exp(each, out=each)
    return np.asarray((elementary.log(each.sum(0)) + top).T)


def coverage(levels: ArrayLike, probability: float) -> float:
    """Share of values inside their highest-density region of a given probability."""
    return float((np.asarray(levels) <= probability).mean())


def calibration_error(levels: ArrayLike) -> float:
    """Mean absolute difference of coverage and probability, over 0.05, 0.1, ... 0.95."""
    probabilities = np.arange(1, 20) / 20
    return float(np.mean([abs(coverage(levels, p) - p) for p in probabilities]))
