"""The modes of a sequence of mixtures under a dynamical model, and the Gaussians of their paths.

Modes that overlap are one explanation of the observation rather than two. Where they are merged
into one Gaussian with their mean and covariance, a path stands for all paths through the modes that
it merged, and few trajectories cover what many would have to (VMS 4).

Where the likelihood is a mixture at every time, the posterior is a mixture too, with a component
for every path k = (k_1 .. k_T):

    w_k N(X; M_k, P_k^-1),     P_k = P + diag(S_{k_t}^-1),     P_k M_k = h + (S_{k_t}^-1 m_{k_t})

    log w_k = sum_t log (w_{k_t} N(0; m_{k_t}, S_{k_t})) + (M_k' P_k M_k - log |P_k / 2 pi|) / 2 - c

with P, h and c those of the prior. Modes that overlap have fewer optima than paths; where optima
are few, these Gaussians stand beside them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dtrtrs

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.block_tridiagonal import (
    BackwardCholesky,
    BlockCholesky,
    NotPositiveDefiniteError,
    add_diagonal,
    factorise_band,
)
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics, TrajectoryPrior
from hmt_ros.inference.reduction import merged_if_close
from hmt_ros.smoothing.embedded_network import EmbeddedNetwork, embedded_network
from hmt_ros.smoothing.likelihood import MixtureLikelihood, WindowLikelihood
from hmt_ros.smoothing.paths import (
    Paths,
    distinct_paths,
    diverse_subset,
    k_best_paths,
    paths_through_nodes,
)

# Candidates for each path that is chosen.
CANDIDATES = 4


@dataclass(frozen=True, eq=False)
class ModeSequence:
    """Mixtures at T times.

    Attributes:
        mixtures: over the d variables of the pose, T of them; T-1 where `first` is given.
        dynamics: of the state, n variables.
        intervals: (T-1,) s.
        first: a density of the first state, over n variables, in the place of a likelihood.
        known: with `first`: -log of `mixtures` alone; None: it is to be made.
        given: paths that are known to be probable; None: they are to be found.
    """

    mixtures: tuple[GaussianMixture, ...]
    dynamics: LinearGaussianDynamics
    intervals: Array
    first: GaussianMixture | None = None
    known: MixtureLikelihood | None = None
    given: Paths | None = None

    @property
    def layers(self) -> tuple[GaussianMixture, ...]:
        """The mixtures at all T times."""
        return self.mixtures if self.first is None else (self.first, *self.mixtures)

    @cached_property
    def likelihood(self) -> MixtureLikelihood | WindowLikelihood:
        """-log of the mixtures."""
        if self.first is None:
            return MixtureLikelihood.of(self.mixtures)
        later = None
        if self.mixtures:
            later = self.known or MixtureLikelihood.of(self.mixtures)
        return WindowLikelihood(MixtureLikelihood.of([self.first]), later)

    @cached_property
    def prior(self) -> TrajectoryPrior:
        """Of the states; with `first`, all variables of the state count as observed."""
        if self.first is None:
            return self.dynamics.prior(self.intervals)
        prior = self.dynamics.prior(self.intervals, initial=False)
        return replace(prior, dimension=self.dynamics.state_dimension)

    @cached_property
    def network(self) -> EmbeddedNetwork:
        """The embedded network."""
        return embedded_network(self.mixtures, self.dynamics, self.intervals, self.first)

    def paths(self, count: int, *, through_modes: bool = False) -> Paths:
        """At most `count` paths that are probable and differ from each other.

        The best of each pair of ends; where that makes less, further ones of the same pairs. With
        `through_modes` the best path through every single mode is a candidate too.
        """
        pairs = len(self.network.nodes[0]) * len(self.network.nodes[-1])
        per_pair = 1 if pairs >= count else -(-CANDIDATES * count // pairs)
        found = k_best_paths(self.network, per_pair)
        if through_modes:
            more = paths_through_nodes(self.network)
            found = distinct_paths(
                Paths(
                    np.concatenate([found.nodes, more.nodes]),
                    np.concatenate([found.log_values, more.log_values]),
                )
            )
        return diverse_subset(found, count)

    def states(self, paths: Paths) -> Array:
        """States (P, T, n) along the modes of paths; velocities are differences of neighbours."""
        d, n = self.dynamics.dimension, self.dynamics.state_dimension
        layers = self.layers
        result = np.zeros((len(paths), len(layers), n))
        for t, mixture in enumerate(layers):
            result[:, t, :d] = mixture.means[paths.nodes[:, t], :d]
        if n == 2 * d and len(layers) > 1:
            edges = np.concatenate([[0.0], np.cumsum(self.intervals)])
            result[:, :, d:] = np.gradient(result[:, :, :d], edges, axis=1)
        if self.first is not None:
            result[:, 0] = self.first.means[paths.nodes[:, 0]]
        return result

    def merged(self, distance: float) -> ModeSequence:
        """The sequence with modes merged that are closer than so many standard deviations."""
        mixtures = tuple(merged_if_close(mixture, distance) for mixture in self.mixtures)
        return replace(self, mixtures=mixtures, known=None, given=None)


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


def path_gaussians_from_the_end(
    nodes: Index, prior: TrajectoryPrior, likelihood: MixtureLikelihood | WindowLikelihood
) -> tuple[Array, Array, tuple[BackwardCholesky, ...]]:
    """States, log weights and factors as of `path_gaussians`, eliminated from the last time on.

    What paths have in common from a time on is computed once: those of a window differ in its first
    state, and few of them after it.

    Raises:
        NotPositiveDefiniteError: the precision of a path is not positive definite.
    """
    count, times = nodes.shape
    n = prior.information.shape[1]
    # From the last time to the first: of each path, which of the distinct ends it has; of these
    # their log weights, the blocks R_t and W_{t-1}, and y_t of R y = right side.
    owners: list[Index] = []
    roots: list[Array] = []
    besides: list[Array] = []
    whites: list[Array] = []
    owner, log = np.zeros(count, dtype=np.intp), np.zeros(1)
    for t in range(times - 1, -1, -1):
        _, chosen, inverse = np.unique(
            np.stack([nodes[:, t], owner]), axis=1, return_index=True, return_inverse=True
        )
        mode, later, owner = nodes[chosen, t], owner[chosen], inverse.reshape(-1)
        log_scales, means, precisions = likelihood.modes_at(t)
        pull = (precisions @ means[:, :, None])[:, :, 0]
        d = pull.shape[1]
        log = log[later] + (log_scales - 0.5 * np.einsum('kd,kd->k', means, pull))[mode]
        matrix = np.tile(prior.precision.diagonal[t], (len(mode), 1, 1))
        matrix[:, :d, :d] += precisions[mode]
        right = np.tile(prior.information[t], (len(mode), 1))
        right[:, :d] += pull[mode]
        if besides:
            matrix -= (besides[-1] @ besides[-1].swapaxes(1, 2))[later]
            right -= (besides[-1] @ whites[-1][:, :, None])[later, :, 0]
        root = _cholesky(matrix)
        if root is None:
            raise NotPositiveDefiniteError(
                f'the precision of a path is not positive definite at time {t} of {times}'
            )
        white = np.array([dtrtrs(r, y, lower=1)[0] for r, y in zip(root, right)])
        log += 0.5 * (white * white).sum(1)
        log -= np.log(np.diagonal(root, axis1=1, axis2=2)).sum(1)
        owners.append(owner)
        roots.append(root)
        whites.append(white)
        if t > 0:
            coupling = prior.precision.lower[t - 1]
            besides.append(np.array([dtrtrs(r, coupling, lower=1)[0].T for r in root]))
    owners, roots, besides, whites = owners[::-1], roots[::-1], besides[::-1], whites[::-1]
    states = np.empty((count, times, n))
    for t in range(times):
        for i, root in enumerate(roots[t]):
            mine = owners[t] == i
            right = np.tile(whites[t][i], (mine.sum(), 1))
            if t > 0:
                right -= states[mine, t - 1] @ besides[t - 1][i]
            states[mine, t] = dtrtrs(root, right.T, lower=1, trans=1)[0].T
    factors = tuple(
        BackwardCholesky(
            tuple(root[i] for root, i in zip(roots, ends)),
            tuple(beside[i] for beside, i in zip(besides, ends[1:])),
        )
        for ends in np.stack(owners, axis=1)
    )
    return states, log[owner] - prior.constant + 0.5 * times * n * np.log(2 * np.pi), factors


def _cholesky(matrices: Array) -> Array | None:
    """Lower factors of matrices (K, n, n); None: one is not positive definite, or not finite."""
    try:
        factors = np.asarray(np.linalg.cholesky(matrices), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    # numpy lets NaN pass.
    return factors if np.isfinite(factors[:, -1, -1]).all() else None


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
