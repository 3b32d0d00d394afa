"""The kernels of the smoother in vectorised numpy: the same numbers, to compare time and values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from hmt_ros.inference import GaussianMixture

Array = NDArray[np.float64]


def pair_log_densities(
    means_a: Array, covariances_a: Array, means_b: Array, covariances_b: Array, pairs: Array
) -> Array:
    """log N(a_i; b_j, A_i + B_j), (P,), of pairs (P, 2)."""
    i, j = pairs.T
    factors = np.linalg.cholesky(covariances_a[i] + covariances_b[j])
    white = np.linalg.solve(factors, (means_a[i] - means_b[j])[:, :, None])[:, :, 0]
    log_det = 2.0 * np.log(np.diagonal(factors, axis1=1, axis2=2)).sum(1)
    result: Array = -0.5 * ((white**2).sum(1) + log_det + white.shape[1] * np.log(2 * np.pi))
    return result


def mixture_energy(
    mixtures: list[GaussianMixture], whiteners: list[Array], precisions: list[Array],
    poses: Array, times: NDArray[np.intp],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """-log of mixtures at poses (N, d) of times (N,), gradient and exact Hessian."""
    n, d = poses.shape
    value, gradient, hessian = np.empty(n), np.empty((n, d)), np.empty((n, d, d))
    for t, (mixture, whitener, precision) in enumerate(
        zip(mixtures, whiteners, precisions, strict=True)
    ):
        at = np.flatnonzero(times == t)
        offset = poses[at, None] - mixture.means
        white = np.einsum('kab,nkb->nka', whitener, offset, optimize=True)
        log = np.log(mixture.weights) - 0.5 * (white**2).sum(2) - 0.5 * d * np.log(2 * np.pi)
        log += np.log(np.diagonal(whitener, axis1=1, axis2=2)).sum(1)
        total = logsumexp(log, axis=1)
        share = np.exp(log - total[:, None])
        pull = np.einsum('kab,nka->nkb', whitener, white, optimize=True)
        mean = (share[:, :, None] * pull).sum(1)
        spread = pull - mean[:, None]
        value[at], gradient[at] = -total, mean
        hessian[at] = (share @ precision.reshape(len(mixture), -1)).reshape(-1, d, d)
        hessian[at] -= (share[:, :, None] * spread).swapaxes(1, 2) @ spread
    return value, gradient, hessian


def band_product(columns: Array, x: Array) -> Array:
    """P x, (S, D), of vectors x (S, D) and P in the columns (D, width + 1) of a band."""
    total, width = columns.shape
    result = columns[:, 0] * x
    for b in range(1, width):
        result[:, b:] += columns[: total - b, b] * x[:, : total - b]
        result[:, : total - b] += columns[: total - b, b] * x[:, b:]
    return result


def log_overlaps(
    samples: Array, log_weights: Array, log_scales: Array, means: Array, bands: Array
) -> tuple[Array, Array]:
    """log q (S,) of a mixture over trajectories at samples (S, D), and its gradient."""
    count, total, width = bands.shape
    white = np.empty((count, *samples.shape))
    for j in range(count):
        delta = samples - means[j]
        white[j] = bands[j, :, 0] * delta
        for b in range(1, width):
            white[j, :, : total - b] += bands[j, : total - b, b] * delta[:, b:]
    log = (log_weights + log_scales)[:, None] - 0.5 * (white**2).sum(2)
    density = logsumexp(log, axis=0)
    share = np.exp(log - density)
    gradient = np.zeros_like(samples)
    for j in range(count):
        pull = bands[j, :, 0] * white[j]
        for b in range(1, width):
            pull[:, b:] += bands[j, : total - b, b] * white[j, :, : total - b]
        gradient -= share[j][:, None] * pull
    return density, gradient
