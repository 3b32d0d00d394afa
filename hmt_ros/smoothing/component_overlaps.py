"""The log density of a mixture over trajectories at samples of its own components, with gradients.

    q(X) = sum_j a_j N(X; M_j, s_j^2 P_j^-1),  P_j = L_j L_j'

L_j' is read column by column from the band. Most components are far from each other, and two that
are need not be compared: of the samples of i, those that j is responsible for have at most the
probability

    E_i[a_j q_j / (a_i q_i + a_j q_j)] <= (a_j / a_i)^(1/2) / 2 int (q_i q_j)^(1/2)

and the overlap of two trajectories is at most that of their poses at any one time, for Gaussians at
most exp(-1/4 D'(C_i + C_j)^-1 D). Pairs below exp(-30) are left out. For the others the distance is
summed from the time at which they are farthest apart, until it exceeds a threshold.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.exact_sums import dot

# Logarithms of overlaps and of densities that make no difference.
NEGLIGIBLE = 30.0
NEGLIGIBLE_DENSITY = 40.0
# Columns between two looks at whether a component still counts.
STRIDE = 32


@njit(cache=True, nogil=True)
def add_overlaps(
    own: int,
    samples: Array,
    noise: Array,
    log_weights: Array,
    log_scales: Array,
    means: Array,
    inflation: Array,
    bands: Array,
    near: NDArray[np.bool_],
    begin: NDArray[np.int64],
    derivatives: bool,
    share: float,
    log_density: Array,
    gradient: Array,
    mean_gradient: Array,
    inflation_gradient: Array,
    weight_gradient: Array,
) -> None:
    """Evaluates log q at the samples of one component, and adds its derivatives.

    Args:
        own: which component the samples are from.
        samples, noise: (S, D) M + s L'^-1 z, and z, with D = T n.
        log_weights: (M,) log a_j.
        log_scales: (M,) log |P_j|^(1/2) - D log s_j - D log(2 pi) / 2.
        means: (M, D).
        inflation: (M,) s_j.
        bands: (M, D, width + 1) L_j: [c, r - c] = L[r, c].
        near: (M,) components that may overlap with `own`.
        begin: (M,) column at which the comparison with each begins.
        derivatives: whether they are wanted; else only `log_density` is written.
        share: weight of a sample in the sums over samples below.
        log_density: (S,) log q, written.
        gradient: (S, D) of log q with regard to the sample, written.
        mean_gradient, inflation_gradient, weight_gradient: (M, D), (M,), (M,); the derivatives of
            the sum of log q with regard to means, log s and log a at fixed samples are added.
    """
    count, total = samples.shape
    components, width = len(means), bands.shape[2]
    white = np.empty((components, total))
    delta = np.empty(total + width)
    delta[total:] = 0.0
    squares = np.empty(components)
    logs = np.empty(components)
    pull = np.empty(total)
    for s in range(count):
        best = -np.inf
        for order in range(components):
            j = own if order == 0 else (order - 1 if order <= own else order)
            log = log_weights[j] + log_scales[j]
            square = 0.0
            if j == own:
                white[j] = noise[s]
                square = dot(noise[s], noise[s], 0, total)
                log -= 0.5 * square
            else:
                if not near[j]:
                    logs[j] = -np.inf
                    continue
                inverse = 1.0 / inflation[j]
                for c in range(total):
                    delta[c] = (samples[s, c] - means[j, c]) * inverse
                for i in range(total):
                    c = begin[j] + i
                    if c >= total:
                        c -= total
                    y = dot(bands[j, c], delta, c, width)
                    white[j, c] = y
                    square += y * y
                    if i % STRIDE == 0 and log - 0.5 * square < best - NEGLIGIBLE_DENSITY:
                        break
                log -= 0.5 * square
            squares[j] = square
            logs[j] = log
            best = max(best, log)
        density = 0.0
        for j in range(components):
            if logs[j] > best - NEGLIGIBLE_DENSITY:
                logs[j] = np.exp(logs[j] - best)
                density += logs[j]
            else:
                logs[j] = 0.0
        log_density[s] = best + np.log(density)
        if not derivatives:
            continue
        gradient[s] = 0.0
        for j in range(components):
            responsibility = logs[j] / density
            if responsibility < 1e-15:
                continue
            # P (x - M) / s^2 = L (L' (x - M) / s) / s
            pull[:] = 0.0
            for c in range(total):
                y = white[j, c]
                last = min(width, total - c)
                for b in range(last):
                    pull[c + b] += y * bands[j, c, b]
            factor = responsibility / inflation[j]
            for c in range(total):
                move = factor * pull[c]
                gradient[s, c] -= move
                mean_gradient[j, c] += share * move
            inflation_gradient[j] += share * responsibility * (squares[j] - total)
            weight_gradient[j] += share * responsibility
