"""Distances and overlaps of pairs of Gaussians, many at once.

D = (a - b)' C^-1 (a - b),     log N(a; b, C) = -1/2 (D + log |C| + d log(2 pi)),     C = A + B
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.threads import in_threads

Index = NDArray[np.int64]

# Pairs whose covariances are factorised side by side.
LANES = 4
# Pairs that are worth a thread.
LEAST_SHARED = 128


def pair_log_densities(
    means_a: Array, covariances_a: Array, means_b: Array, covariances_b: Array, pairs: Index
) -> Array:
    """log N(a_i; b_j, A_i + B_j), shape (P,), of pairs (P, 2) of indices i, j."""
    squares, log_determinants = _of_pairs(
        pairs, np.ones((len(pairs), 2)), means_a, covariances_a, means_b, covariances_b
    )
    constant = means_a.shape[1] * np.log(2 * np.pi)
    return np.asarray(-0.5 * (squares + log_determinants + constant))


def pair_distances(means: Array, covariances: Array, scales: Array, pairs: Index) -> Array:
    """(m_i - m_j)' (s_i C_i + s_j C_j)^-1 (m_i - m_j), shape (P,), of pairs (P, 2)."""
    return _of_pairs(pairs, scales[pairs], means, covariances, means, covariances)[0]


def pair_mixture_log_determinants(
    means: Array, covariances: Array, weights: Array, pairs: Index
) -> Array:
    """log |S|, shape (P,), of the covariances S that pairs (P, 2) of weighted Gaussians have.

    S = a A + b B + a b D D' with the shares a + b = 1 of the weights and the offset D of the means,
    so that log |S| = log |a A + b B| + log(1 + a b D' (a A + b B)^-1 D).
    """
    shares = weights[pairs] / weights[pairs].sum(1, keepdims=True)
    squares, log_determinants = _of_pairs(pairs, shares, means, covariances, means, covariances)
    return np.asarray(log_determinants + np.log1p(shares[:, 0] * shares[:, 1] * squares))


def _of_pairs(pairs: Index, scales: Array, *sets: Array) -> tuple[Array, Array]:
    """D and log |C|, both (P,), of pairs from two sets of means and covariances.

    Args:
        pairs: (P, 2).
        scales: (P, 2) factors on the two covariances of each pair.
        *sets: means and covariances of the first set, and of the second.
    """
    # Arrays of one kind: for others, read-only ones for example, another kernel would be compiled.
    a, big_a, b, big_b, s = (np.require(x, np.float64, ('C', 'W')) for x in (*sets, scales))
    pairs = np.require(pairs, np.int64, ('C', 'W'))
    squares, log_determinants = np.empty((2, len(pairs)))

    def work(first: int, last: int) -> None:
        at = slice(first, last)
        _whitened_pairs(a, big_a, b, big_b, pairs[at], s[at], squares[at], log_determinants[at])

    in_threads(work, len(pairs), LEAST_SHARED)
    return squares, log_determinants


@njit(cache=True, nogil=True)
def _whitened_pairs(
    means_a: Array,
    covariances_a: Array,
    means_b: Array,
    covariances_b: Array,
    pairs: Index,
    scales: Array,
    squares: Array,
    log_determinants: Array,
) -> None:
    """Cholesky factors and forward substitution of four pairs at a time, two columns at a time.

    The last row of each factor is the offset, which becomes the whitened offset.
    """
    d = means_a.shape[1]
    f = np.empty((d + 1, d, LANES))
    for first in range(0, len(pairs), LANES):
        count = min(LANES, len(pairs) - first)
        for lane in range(LANES):
            p = first + min(lane, count - 1)
            i, j = pairs[p]
            for a in range(d):
                f[d, a, lane] = means_a[i, a] - means_b[j, a]
                for b in range(a + 1):
                    one, two = covariances_a[i, a, b], covariances_b[j, a, b]
                    f[a, b, lane] = scales[p, 0] * one + scales[p, 1] * two
        for i in range(d + 1):
            j = 0
            while j + 1 < i:
                p0, p1, p2, p3 = f[i, j, 0], f[i, j, 1], f[i, j, 2], f[i, j, 3]
                q0, q1, q2, q3 = f[i, j + 1, 0], f[i, j + 1, 1], f[i, j + 1, 2], f[i, j + 1, 3]
                for k in range(j):
                    x0, x1, x2, x3 = f[i, k, 0], f[i, k, 1], f[i, k, 2], f[i, k, 3]
                    p0 -= x0 * f[j, k, 0]
                    p1 -= x1 * f[j, k, 1]
                    p2 -= x2 * f[j, k, 2]
                    p3 -= x3 * f[j, k, 3]
                    q0 -= x0 * f[j + 1, k, 0]
                    q1 -= x1 * f[j + 1, k, 1]
                    q2 -= x2 * f[j + 1, k, 2]
                    q3 -= x3 * f[j + 1, k, 3]
                # The diagonal holds inverses.
                p0 *= f[j, j, 0]
                p1 *= f[j, j, 1]
                p2 *= f[j, j, 2]
                p3 *= f[j, j, 3]
                f[i, j, 0], f[i, j, 1], f[i, j, 2], f[i, j, 3] = p0, p1, p2, p3
                f[i, j + 1, 0] = (q0 - p0 * f[j + 1, j, 0]) * f[j + 1, j + 1, 0]
                f[i, j + 1, 1] = (q1 - p1 * f[j + 1, j, 1]) * f[j + 1, j + 1, 1]
                f[i, j + 1, 2] = (q2 - p2 * f[j + 1, j, 2]) * f[j + 1, j + 1, 2]
                f[i, j + 1, 3] = (q3 - p3 * f[j + 1, j, 3]) * f[j + 1, j + 1, 3]
                j += 2
            if j < i:
                for lane in range(LANES):
                    total = f[i, j, lane]
                    for k in range(j):
                        total -= f[i, k, lane] * f[j, k, lane]
                    f[i, j, lane] = total * f[j, j, lane]
            if i == d:
                break
            s0, s1, s2, s3 = f[i, i, 0], f[i, i, 1], f[i, i, 2], f[i, i, 3]
            for k in range(i):
                s0 -= f[i, k, 0] * f[i, k, 0]
                s1 -= f[i, k, 1] * f[i, k, 1]
                s2 -= f[i, k, 2] * f[i, k, 2]
                s3 -= f[i, k, 3] * f[i, k, 3]
            f[i, i, 0] = 1.0 / np.sqrt(s0)
            f[i, i, 1] = 1.0 / np.sqrt(s1)
            f[i, i, 2] = 1.0 / np.sqrt(s2)
            f[i, i, 3] = 1.0 / np.sqrt(s3)
        for lane in range(count):
            square = log_determinant = 0.0
            for a in range(d):
                square += f[d, a, lane] ** 2
                log_determinant -= 2.0 * np.log(f[a, a, lane])
            squares[first + lane], log_determinants[first + lane] = square, log_determinant
