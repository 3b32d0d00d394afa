"""Exact smoothing posteriors to compare with, by enumeration or on a grid, and a particle smoother.

Where the likelihood is a mixture of K Gaussians at each of T times, the posterior is a mixture of
K^T.
"""

from __future__ import annotations

import itertools
import time

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics

Array = NDArray[np.float64]


def modes(kind: str, seed: int, times: int, count: int = 3, dimension: int = 2) -> list:
    """Mixtures whose modes are "separated" by ten standard deviations or "overlapping" by two."""
    rng = np.random.default_rng(seed)
    radius = {'separated': 6.0, 'overlapping': 1.5}[kind]
    angle = rng.uniform(0, 2 * np.pi) + 2 * np.pi * np.arange(count) / count
    if dimension == 1:
        centres = radius * (np.arange(count) - 0.5 * (count - 1))[:, None]
    else:
        centres = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    mixtures = []
    drift = np.zeros_like(centres)
    for _ in range(times):
        drift = 0.9 * drift + 0.5 * rng.normal(size=centres.shape)
        factors = 0.4 * rng.normal(size=(count, dimension, dimension))
        covariances = factors @ factors.swapaxes(1, 2) + 0.4 * np.eye(dimension)
        weights = rng.dirichlet(np.full(count, 3.0)) * rng.uniform(0.5, 2.0)
        mixtures.append(GaussianMixture(weights, centres + drift, covariances))
    return mixtures


def enumerated(mixtures: list, dynamics: LinearGaussianDynamics) -> list:
    """Marginals of the exact posterior at each time, K^T components, by dense algebra."""
    times, d = len(mixtures), mixtures[0].dimension
    prior = dynamics.prior(np.full(times - 1, dynamics.step))
    dense = np.zeros((times, d, times, d))
    for t in range(times):
        dense[t, :, t] = prior.precision.diagonal[t]
    for t, block in enumerate(prior.precision.lower):
        dense[t + 1, :, t], dense[t, :, t + 1] = block, block.T
    inverses = [np.linalg.inv(mixture.covariances) for mixture in mixtures]
    logs, means, covariances = [], [], []
    for path in itertools.product(*(range(len(mixture)) for mixture in mixtures)):
        precision, pull, log = dense.copy(), prior.information.copy(), -prior.constant
        for t, (mixture, k) in enumerate(zip(mixtures, path)):
            precision[t, :, t] += inverses[t][k]
            one = inverses[t][k] @ mixture.means[k]
            pull[t] += one
            log += np.log(mixture.weights[k]) - 0.5 * mixture.means[k] @ one
            log -= 0.5 * np.linalg.slogdet(2 * np.pi * mixture.covariances[k])[1]
        covariance = np.linalg.inv(precision.reshape(times * d, -1))
        mean = covariance @ pull.reshape(-1)
        log += 0.5 * mean @ pull.reshape(-1) + 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
        logs.append(log)
        means.append(mean.reshape(times, d))
        covariances.append(covariance.reshape(times, d, times, d))
    weights = np.exp(np.array(logs) - logsumexp(logs))
    return [
        GaussianMixture(
            weights / weights.sum(),
            np.array([mean[t] for mean in means]),
            np.array([covariance[t, :, t] for covariance in covariances]),
        )
        for t in range(times)
    ]


def divergence(exact: GaussianMixture, log_density, rng: np.random.Generator, n: int = 2000):
    """KL(exact || other) in nats, by samples of the exact density."""
    exact = exact[exact.weights > 1e-8].normalised()
    x = exact.sample(n, rng)
    return float((exact.log_density(x) - log_density(x)).mean())


def grid_marginals(mixtures: list, dynamics: LinearGaussianDynamics, grid: Array) -> Array:
    """Densities (T, G) of exact marginals in 1-D on a grid, by forward and backward sums."""
    step = grid[1] - grid[0]
    a, q = dynamics.transition(dynamics.step)
    move = grid[None, :] - a[0, 0] * grid[:, None]
    log_kernel = -0.5 * (move**2 / q[0, 0] + np.log(2 * np.pi * q[0, 0])) + np.log(step)
    logs = [mixture.log_density(grid[:, None]) for mixture in mixtures]
    forward = [logs[0]]
    for log in logs[1:]:
        forward.append(log + logsumexp(forward[-1][:, None] + log_kernel, axis=0))
    backward = [np.zeros(len(grid))]
    for log in logs[:0:-1]:
        backward.append(logsumexp(log_kernel + (log + backward[-1])[None], axis=1))
    both = np.array(forward) + np.array(backward[::-1])
    both -= logsumexp(both, axis=1, keepdims=True)
    return np.exp(both) / step


def particle_marginals(
    mixtures: list, dynamics: LinearGaussianDynamics, seconds: float, seed: int
) -> list:
    """Forward filtering, backward sampling within a time, as Gaussian kernels at each time.

    Proposals are the components of the likelihood, the best choice for it here; particles and
    backward trajectories are as many as the time allows. The kernel's width is Silverman's, in each
    of the modes that the particles came from.
    """
    count = 64
    start = time.perf_counter()
    found = _ffbs(mixtures, dynamics, count, seed)
    spent = time.perf_counter() - start
    while spent < 0.35 * seconds and count < 16384:
        count = int(count * min(2.0, max(1.2, np.sqrt(seconds / max(spent, 1e-6)))))
        start = time.perf_counter()
        found = _ffbs(mixtures, dynamics, count, seed)
        spent = time.perf_counter() - start
    result = []
    for points, owners in found:
        n, d = points.shape
        parts = []
        for k in np.unique(owners):
            mine = points[owners == k]
            spread = np.cov(mine.T).reshape(d, d) if len(mine) > d + 1 else np.eye(d)
            scale = (4 / (d + 2)) ** (1 / (d + 4)) * max(len(mine), 2) ** (-1 / (d + 4))
            width = scale**2 * spread + 1e-6 * np.eye(d)
            parts.append((np.full(len(mine), 1 / n), mine, np.tile(width, (len(mine), 1, 1))))
        result.append(GaussianMixture(*(np.concatenate(x) for x in zip(*parts))))
    return result


def _ffbs(mixtures: list, dynamics: LinearGaussianDynamics, count: int, seed: int) -> list:
    rng = np.random.default_rng(seed)
    a, q = dynamics.transition(dynamics.step)
    inverse = np.linalg.inv(np.linalg.cholesky(q))
    points, owners, logs = [], [], []
    for t, mixture in enumerate(mixtures):
        normalised = mixture.normalised()
        k = rng.choice(len(mixture), size=count, p=normalised.weights)
        noise = rng.standard_normal((count, mixture.dimension))
        x = mixture.means[k] + np.einsum('nij,nj->ni', mixture.cholesky()[k], noise)
        if t == 0:
            log = np.zeros(count)
        else:
            log = logsumexp(_transition(points[-1] @ a.T, x, inverse) + logs[-1][:, None], axis=0)
        points.append(x)
        owners.append(k)
        logs.append(log - logsumexp(log))
    index = rng.choice(count, size=count, p=np.exp(logs[-1]))
    result = [(points[-1][index], owners[-1][index])]
    for t in range(len(mixtures) - 2, -1, -1):
        log = logs[t][:, None] + _transition(points[t] @ a.T, points[t + 1][index], inverse)
        weights = np.exp(log - log.max(0))
        cumulated = np.cumsum(weights, axis=0)
        drawn = rng.random(count) * cumulated[-1]
        index = np.minimum((cumulated < drawn).sum(0), count - 1)
        result.append((points[t][index], owners[t][index]))
    return result[::-1]


def _transition(moved: Array, x: Array, inverse: Array) -> Array:
    """log p (N, M) up to a constant."""
    a, b = moved @ inverse.T, x @ inverse.T
    return -0.5 * ((a * a).sum(1)[:, None] + (b * b).sum(1)[None] - 2 * a @ b.T)
