"""The network of likelihood modes: nodes are modes, links are transitions between them (VMS 4).

    node  p(r_t | m_i)  = int p(r_t | x) m_i(x) dx           = sum_j w_j N(mu_i; mu_j, S_i + S_j)
    link  p(m_j | m_i)  = int int m_j(y) p(y | x) m_i(x)     = N(mu_j; A mu_i, S_j + A S_i A' + Q)

in closed form. Where the state has velocities, the link integrates over what is known of them at
first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.gaussian_pairs import pair_log_densities
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.smoothing.likelihood import check_mixtures

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class EmbeddedNetwork:
    """Layers of nodes, each connected with the next one.

    Attributes:
        nodes: T arrays (K_t,), log node values.
        links: T-1 arrays (K_t, K_{t+1}), log link values.
    """

    nodes: tuple[Array, ...]
    links: tuple[Array, ...]

    @property
    def times(self) -> int:
        """T."""
        return len(self.nodes)

    def log_value(self, path: NDArray[np.intp]) -> float:
        """Sum of the log values along a path (T,)."""
        total = sum(float(nodes[k]) for nodes, k in zip(self.nodes, path))
        return total + sum(
            float(links[i, j]) for links, i, j in zip(self.links, path[:-1], path[1:])
        )


def embedded_network(
    mixtures: Sequence[GaussianMixture],
    dynamics: LinearGaussianDynamics,
    intervals: Array,
    first: GaussianMixture | None = None,
) -> EmbeddedNetwork:
    """The network of Gaussian modes, in closed form.

    Args:
        mixtures: T mixtures over the pose.
        dynamics: of the state.
        intervals: (T-1,) s; (T,) with `first`.
        first: a density of the state (n variables) at a time before the mixtures; its components
            are the first layer of nodes.

    Raises:
        ValueError: mixtures that can not be smoothed.
    """
    if first is not None:
        return _with_first(first, mixtures, dynamics, intervals)
    check_mixtures(mixtures, factorise=False)
    d, n = dynamics.dimension, dynamics.state_dimension
    begin = np.concatenate([[0], np.cumsum([len(mixture) for mixture in mixtures])])
    means = np.concatenate([mixture.means for mixture in mixtures])
    covariances = np.concatenate([mixture.covariances for mixture in mixtures])
    different, which = np.unique(intervals, return_inverse=True)

    # Where every mode is expected at the next time, and how widely.
    predicted, spread = np.empty_like(means), np.empty_like(covariances)
    for i, interval in enumerate(different):
        a, q = dynamics.transition(float(interval))
        own, other = a[:d, :d], a[:d, d:]
        noise = q[:d, :d] + other @ dynamics.unknown_velocity @ other.T if n > d else q
        at: Any = slice(0, begin[-2])
        if len(different) > 1:
            at = np.repeat(which == i, np.diff(begin[:-1])).nonzero()[0]
        if np.array_equal(own, np.eye(d)):
            predicted[at] = means[at]
            spread[at] = covariances[at] + noise
        else:
            predicted[at] = means[at] @ own.T
            spread[at] = own @ covariances[at] @ own.T + noise

    # All pairs in one go: the modes of a time with each other, and with those of the next time.
    within = [_pairs_within(len(mixture)) for mixture in mixtures]
    node_pairs = np.concatenate([begin[t] + pairs for t, pairs in enumerate(within)], axis=1).T
    across = [_pairs_across(len(a), len(b)) for a, b in pairwise(mixtures)]
    link_pairs = np.concatenate(
        [begin[t : t + 2, None] + pairs for t, pairs in enumerate(across)]
        or [np.zeros((2, 0), dtype=np.int64)],
        axis=1,
    ).T
    node_values = pair_log_densities(means, covariances, means, covariances, node_pairs)
    link_values = pair_log_densities(predicted, spread, means, covariances, link_pairs)
    if not np.isfinite(node_values).all():
        # A factorisation has failed: the check says where.
        check_mixtures(mixtures)

    nodes, links = [], []
    done = 0
    for mixture, pairs in zip(mixtures, within):
        nodes.append(_node_values(mixture.weights, node_values[done:], pairs))
        done += pairs.shape[1]
    done = 0
    for left, right in pairwise(mixtures):
        size = len(left) * len(right)
        links.append(link_values[done : done + size].reshape(len(left), len(right)))
        done += size
    return EmbeddedNetwork(tuple(nodes), tuple(links))


def _node_values(weights: Array, densities: Array, pairs: Index) -> Array:
    """log (K,) of the sums over modes of weights times densities, given for pairs (2, P)."""
    row, column = pairs
    log = np.empty((len(weights), len(weights)))
    log[row, column] = log[column, row] = densities[: len(row)]
    # scipy's logsumexp, without what it spends on axes and signs.
    top = log.max(1, keepdims=True)
    result: Array = np.log(np.exp(log - top) @ weights) + top[:, 0]
    return result


@lru_cache(maxsize=256)
def _pairs_within(count: int) -> Index:
    return np.array(np.triu_indices(count), dtype=np.int64)


@lru_cache(maxsize=256)
def _pairs_across(before: int, after: int) -> Index:
    return np.indices((before, after)).reshape(2, -1)


def _with_first(
    first: GaussianMixture,
    mixtures: Sequence[GaussianMixture],
    dynamics: LinearGaussianDynamics,
    intervals: Array,
) -> EmbeddedNetwork:
    """The network with a layer of components of the state before the modes."""
    pairs = _pairs_within(len(first))
    own = pair_log_densities(
        first.means, first.covariances, first.means, first.covariances, pairs.T
    )
    nodes = _node_values(first.weights, own, pairs)
    if len(mixtures) == 0:
        return EmbeddedNetwork((nodes,), ())
    rest = embedded_network(mixtures, dynamics, intervals[1:])
    d = dynamics.dimension
    means, spread = dynamics.predict(first.means, first.covariances, float(intervals[0]))
    pairs = _pairs_across(len(first), len(mixtures[0]))
    links = pair_log_densities(
        means[:, :d], spread[:, :d, :d], mixtures[0].means, mixtures[0].covariances, pairs.T
    )
    return EmbeddedNetwork(
        (nodes, *rest.nodes), (links.reshape(len(first), len(mixtures[0])), *rest.links)
    )
