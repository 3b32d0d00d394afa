"""Modes of a sequence of mixtures under a dynamical model, and Gaussians of paths through them.

Overlapping modes are a single explanation of the observation. If they are merged into one Gaussian
of the same mean and covariance, one path represents all paths through them, so that fewer
trajectories cover the posterior (VMS 4).

If the likelihood is a mixture at every time, the posterior is a mixture too, with a component for
every path k = (k_1 .. k_T):

    w_k N(X; M_k, P_k^-1),     P_k = P + diag(S_{k_t}^-1),     P_k M_k = h + (S_{k_t}^-1 m_{k_t})

    log w_k = sum_t log (w_{k_t} N(0; m_{k_t}, S_{k_t})) + (M_k' P_k M_k - log |P_k / 2 pi|) / 2 - c

with P, h and c from the prior. If modes overlap, there are fewer optima than paths. The Gaussians
of paths then complement the optima.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hmt_ros.core import add_diagonal, elementary
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.block_tridiagonal import (
    BlockCholesky,
    factorise,
)
from hmt_ros.inference.linear_algebra import log_sum_exp, product
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics, TrajectoryPrior
from hmt_ros.inference.reduction import merged_if_close
from hmt_ros.smoothing.embedded_network import (
    EmbeddedNetwork,
    Paths,
    diverse_subset,
    embedded_network,
    k_best_paths,
)
from hmt_ros.smoothing.likelihood import MixtureLikelihood

# Number of candidate paths per selected path.
CANDIDATES_PER_PATH = 4


@dataclass(frozen=True, eq=False)
class ModeSequence:
    """Mixtures at T times.

    Attributes:
        mixtures: T mixtures over the d variables of the pose.
        dynamics: dynamics of the state of n variables.
        intervals: (T-1,) between successive times, s.
    """

    mixtures: tuple[GaussianMixture, ...]
    dynamics: LinearGaussianDynamics
    intervals: Array

    @cached_property
    def likelihood(self) -> MixtureLikelihood:
        """The mixtures as a likelihood."""
        return MixtureLikelihood.of(self.mixtures)

    @cached_property
    def prior(self) -> TrajectoryPrior:
        """Prior of the states."""
        return self.dynamics.prior(self.intervals)

    @cached_property
    def network(self) -> EmbeddedNetwork:
        """The embedded network."""
        return embedded_network(self.mixtures, self.dynamics, self.intervals)

    def paths(self, count: int) -> Paths:
        """Return at most `count` probable paths that differ from each other.

        Candidates are the best path for each pair of ends and, if these are too few, further paths
        for the same pairs.
        """
        pairs = len(self.network.nodes[0]) * len(self.network.nodes[-1])
        per_pair = 1 if pairs >= count else -(-CANDIDATES_PER_PATH * count // pairs)
        return diverse_subset(k_best_paths(self.network, per_pair), count)

    def states(self, paths: Paths) -> Array:
        """States (P, T, n) at the modes of paths, with velocities from differences over time."""
        d, n = self.dynamics.dimension, self.dynamics.state_dimension
        result = np.zeros((len(paths), len(self.mixtures), n))
        for t, mixture in enumerate(self.mixtures):
            result[:, t, :d] = mixture.means[paths.nodes[:, t]]
        if n == 2 * d and len(self.mixtures) > 1:
            edges = np.concatenate([[0.0], np.cumsum(self.intervals)])
            result[:, :, d:] = np.gradient(result[:, :, :d], edges, axis=1)
        return result

    def merged(self, distance: float) -> ModeSequence:
        """Merge modes that are closer than `distance` standard deviations."""
        mixtures = tuple(merged_if_close(mixture, distance) for mixture in self.mixtures)
        return replace(self, mixtures=mixtures)


@dataclass(frozen=True, eq=False)
class TrajectoryGaussians:
    """Gaussian components of the posterior, from paths or around optima.

    Attributes:
        states: (P, T, n) means.
        factors: P Cholesky factors of the precisions.
        log_weights: (P,) log of each component's mass in p(X, R).
    """

    states: Array
    factors: tuple[BlockCholesky, ...]
    log_weights: Array

    @property
    def weights(self) -> Array:
        """Proportions (P,) of the components."""
        return np.asarray(elementary.exp(self.log_weights - log_sum_exp(self.log_weights)))


def path_gaussians(
    nodes: Index, prior: TrajectoryPrior, likelihood: MixtureLikelihood
) -> TrajectoryGaussians:
    """The posterior components of paths (P, T), given as indices of modes with positive weight."""
    count, times = nodes.shape
    n, d = prior.information.shape[1], prior.dimension
    states, log_weights, factors = np.empty((count, times, n)), np.empty(count), []
    band = prior.precision.band()
    for i, path in enumerate(nodes):
        log_scales, means, precisions = likelihood.modes_of(path)
        columns = band.copy()
        add_diagonal(columns, precisions, n)
        factor = factorise(columns, times, n)
        right = prior.information.copy()
        pull = product(precisions, means[:, :, None])[:, :, 0]
        right[:, :d] += pull
        states[i] = factor.solve(right)
        log_weights[i] = (
            -prior.constant
            + log_scales.sum()
            - 0.5 * float((means * pull).sum())
            + 0.5 * float((states[i] * right).sum())
            - 0.5 * factor.log_determinant
            + 0.5 * times * n * elementary.log(2 * np.pi)
        )
        factors.append(factor)
    return TrajectoryGaussians(states, tuple(factors), log_weights)
