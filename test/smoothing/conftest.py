"""Small sequences with exactly known posteriors."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy.special import logsumexp

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.smoothing import ImageModes, LinearGaussianDynamics, Link

INDEPENDENT = CueErrors(1.0, 0.0)
Modes = Callable[..., list[GaussianMixture]]


def make_modes(radius: float, seed: int = 0, times: int = 5, k: int = 3, d: int = 2):
    """Mixtures of K modes on a circle, wandering a little."""
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * np.arange(k) / k
    centres = np.zeros((k, d))
    centres[:, 0] = radius * np.cos(angle)
    centres[:, -1] += radius * np.sin(angle) if d > 1 else 0.0
    result = []
    for _ in range(times):
        factors = 0.4 * rng.normal(size=(k, d, d))
        covariances = factors @ factors.swapaxes(1, 2) + 0.3 * np.eye(d)
        means = centres + 0.3 * rng.normal(size=(k, d))
        result.append(GaussianMixture(rng.dirichlet(np.full(k, 4.0)) * 1.7, means, covariances))
    return result


def make_exact(
    mixtures: list[GaussianMixture], dynamics: LinearGaussianDynamics, intervals: np.ndarray
) -> tuple[float, list[GaussianMixture]]:
    """log p(R) and exact marginals of first-order dynamics, all paths enumerated, densely."""
    times, d = len(mixtures), mixtures[0].dimension
    prior = dynamics.prior(intervals)
    dense = np.zeros((times, d, times, d))
    for t in range(times):
        dense[t, :, t] = prior.precision.diagonal[t]
    for t, block in enumerate(prior.precision.lower):
        dense[t + 1, :, t], dense[t, :, t + 1] = block, block.T
    logs, means, covariances = [], [], []
    for path in itertools.product(*(range(len(m)) for m in mixtures)):
        precision, pull, log = dense.copy(), prior.information.copy(), -prior.constant
        for t, (mixture, k) in enumerate(zip(mixtures, path)):
            inverse = np.linalg.inv(mixture.covariances[k])
            precision[t, :, t] += inverse
            pull[t] += inverse @ mixture.means[k]
            log += np.log(mixture.weights[k])
            log -= 0.5 * mixture.means[k] @ inverse @ mixture.means[k]
            log -= 0.5 * np.linalg.slogdet(2 * np.pi * mixture.covariances[k])[1]
        covariance = np.linalg.inv(precision.reshape(times * d, -1))
        mean = covariance @ pull.reshape(-1)
        log += 0.5 * mean @ pull.reshape(-1) + 0.5 * np.linalg.slogdet(2 * np.pi * covariance)[1]
        logs.append(log)
        means.append(mean.reshape(times, d))
        covariances.append(covariance.reshape(times, d, times, d))
    weights = np.exp(np.array(logs) - logsumexp(logs))
    marginals = [
        GaussianMixture(
            weights, np.array([m[t] for m in means]), np.array([c[t, :, t] for c in covariances])
        )
        for t in range(times)
    ]
    return float(logsumexp(logs)), marginals


@pytest.fixture
def modes() -> Modes:
    return make_modes


@pytest.fixture
def exact():
    return make_exact


@pytest.fixture
def walk() -> LinearGaussianDynamics:
    return LinearGaussianDynamics.random_walk([1.0, 2.0])


def make_chained(
    mixtures: Sequence[GaussianMixture],
    stamps: Sequence[int] | None = None,
    *,
    hops: float = 0.0,
    origins: Sequence[np.ndarray] | None = None,
    errors: CueErrors = INDEPENDENT,
) -> list[ImageModes]:
    """Images of a filter whose modes have the weights of the mixtures.

    Args:
        stamps: timestamps, ns; None means a second apart.
        hops: probability that a mode continues each of the others, if `origins` are not given.
    """
    result = []
    for t, mixture in enumerate(mixtures):
        k = len(mixture)
        own = hops + (1.0 - k * hops) * np.eye(k) if t else np.empty((k, 0))
        weights = mixture.weights / mixture.weights.sum()
        link = Link(weights, own if origins is None else origins[t])
        stamp = t * 10**9 if stamps is None else int(stamps[t])
        result.append(ImageModes(stamp, link, mixture, errors))
    return result


def make_dense(mixtures, path, dynamics, intervals, first=None):
    """Means (T, n) and covariances (T, n, T, n) of the states along modes, by dense algebra.

    Args:
        first: mean and precision of the first state; None means those of the dynamics.
    """
    times, n, d = len(path), dynamics.state_dimension, dynamics.dimension
    precision, pull = np.zeros((times, n, times, n)), np.zeros((times, n))
    at, known = first or (dynamics.initial_mean, dynamics.initial_precision)
    precision[0, :, 0], pull[0] = known, known @ at
    for t, interval in enumerate(intervals):
        a, q = dynamics.transition(float(interval))
        inverse = np.linalg.inv(q)
        precision[t, :, t] += a.T @ inverse @ a
        precision[t + 1, :, t + 1] += inverse
        precision[t + 1, :, t] -= inverse @ a
        precision[t, :, t + 1] -= a.T @ inverse
    for t, (mixture, k) in enumerate(zip(mixtures, path, strict=True)):
        inverse = np.linalg.inv(mixture.covariances[k])
        precision[t, :d, t, :d] += inverse
        pull[t, :d] += inverse @ mixture.means[k]
    covariance = np.linalg.inv(precision.reshape(times * n, -1))
    return (covariance @ pull.reshape(-1)).reshape(times, n), covariance.reshape(times, n, times, n)


@pytest.fixture
def chained():
    return make_chained


@pytest.fixture
def dense():
    return make_dense
