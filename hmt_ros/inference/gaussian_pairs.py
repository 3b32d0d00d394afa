"""Distances and overlaps of many pairs of Gaussians.

D = (a - b)' C^-1 (a - b),     log N(a; b, C) = -1/2 (D + log |C| + d log(2 pi)),     C = A + B
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import elementary, whiten_pairs
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.threads import in_threads

Index = NDArray[np.int64]

# Minimum number of pairs per thread.
MIN_PAIRS_PER_THREAD = 128


def pair_log_densities(
    means_a: Array, covariances_a: Array, means_b: Array, covariances_b: Array, pairs: Index
) -> Array:
    """log N(a_i; b_j, A_i + B_j), shape (P,), for pairs (P, 2) of indices i, j."""
    squares, log_determinants = _of_pairs(
        pairs, np.ones((len(pairs), 2)), means_a, covariances_a, means_b, covariances_b
    )
    constant = means_a.shape[1] * elementary.log(2 * np.pi)
    return np.asarray(-0.5 * (squares + log_determinants + constant))


def pair_distances(means: Array, covariances: Array, scales: Array, pairs: Index) -> Array:
    """(m_i - m_j)' (s_i C_i + s_j C_j)^-1 (m_i - m_j), shape (P,), for pairs (P, 2)."""
    return _of_pairs(pairs, scales[pairs], means, covariances, means, covariances)[0]


def pair_mixture_log_determinants(
    means: Array, covariances: Array, weights: Array, pairs: Index
) -> Array:
    """log |S|, shape (P,), for the joint covariance S of pairs (P, 2) of weighted Gaussians.

    S = a A + b B + a b D D' with the normalised weights a + b = 1 and the offset D of the means, so
    that log |S| = log |a A + b B| + log(1 + a b D' (a A + b B)^-1 D).
    """
    shares = weights[pairs] / weights[pairs].sum(1, keepdims=True)
    squares, log_determinants = _of_pairs(pairs, shares, means, covariances, means, covariances)
    return np.asarray(log_determinants + elementary.log1p(shares[:, 0] * shares[:, 1] * squares))


def _of_pairs(pairs: Index, scales: Array, *sets: Array) -> tuple[Array, Array]:
    """D (P,) and log |C| (P,) for pairs from two sets of means and covariances.

    Args:
        pairs: (P, 2) indices in the first set and in the second.
        scales: (P, 2) factors on the two covariances of each pair.
        *sets: means and covariances of the first set, and of the second.
    """
    a, big_a, b, big_b, s = (np.ascontiguousarray(x, np.float64) for x in (*sets, scales))
    pairs = np.ascontiguousarray(pairs, np.int64)
    squares, log_determinants = np.empty((2, len(pairs)))

    def work(first: int, last: int) -> None:
        at = slice(first, last)
        whiten_pairs(a, big_a, b, big_b, pairs[at], s[at], squares[at], log_determinants[at])

    in_threads(work, len(pairs), MIN_PAIRS_PER_THREAD)
    return squares, log_determinants
