"""The Gaussian that belongs to a path through the modes of mixtures.

Where the likelihood is a mixture at every time, the posterior is a mixture too, with a component
for every path k = (k_1 .. k_T):

    w_k N(X; M_k, P_k^-1),  P_k = P + diag(S_{k_t}^-1),  P_k M_k = h + (S_{k_t}^-1 m_{k_t}), log w_k
    = -c + sum_t log (w_{k_t} N(0; m_{k_t}, S_{k_t})) + (M_k' P_k M_k - log |P_k / 2 pi|) / 2

with P, h and c those of the prior. Modes that overlap have fewer optima than paths; where optima
are few, these Gaussians stand beside them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference.block_tridiagonal import BlockCholesky, add_diagonal, factorise_band
from hmt_ros.inference.linear_gaussian_dynamics import TrajectoryPrior
from hmt_ros.smoothing.likelihood import MixtureLikelihood, WindowLikelihood

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class PathGaussians:
    """Components of the posterior.

    Attributes:
        states: (P, T, n) means.
        factors: P Cholesky factors of the precisions.
        log_weights: (P,) log of their mass in p(X, R).
    """

    states: Array
    factors: tuple[BlockCholesky, ...]
    log_weights: Array


def path_gaussians(
    nodes: Index, prior: TrajectoryPrior, likelihood: MixtureLikelihood | WindowLikelihood
) -> PathGaussians:
    """The components of paths (P, T), indices of modes with weight."""
    count, times = nodes.shape
    n, d = prior.information.shape[1], prior.dimension
    states, log_weights, factors = np.empty((count, times, n)), np.empty(count), []
    band = prior.precision.band()
    for i, path in enumerate(nodes):
        log_scales, means, precisions = likelihood.modes_of(path)
        columns = band.copy()
        add_diagonal(columns, precisions, n)
        factor = factorise_band(columns.T, times, n)
        right = prior.information.copy()
        pull = (precisions @ means[:, :, None])[:, :, 0]
        right[:, :d] += pull
        states[i] = factor.solve(right)
        log_weights[i] = (
            -prior.constant
            + log_scales.sum()
            - 0.5 * float(np.vdot(means, pull))
            + 0.5 * float(np.vdot(states[i], right))
            - 0.5 * factor.log_determinant
            + 0.5 * times * n * np.log(2 * np.pi)
        )
        factors.append(factor)
    return PathGaussians(states, tuple(factors), log_weights)
