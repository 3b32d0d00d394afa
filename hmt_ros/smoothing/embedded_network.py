"""The network of likelihood modes: nodes are modes, links are transitions between them (VMS 4).

    node  p(r_t | m_i)  = int p(r_t | x) m_i(x) dx           = sum_j w_j N(mu_i; mu_j, S_i + S_j)
    link  p(m_j | m_i)  = int int m_j(y) p(y | x) m_i(x)     = N(mu_j; A mu_i, S_j + A S_i A' + Q)

in closed form. If the state has velocities, the link integrates over the distribution of an unknown
velocity.

Paths are found by exact max-product over the layers, for all nodes of the first layer at once. The
values of nodes and links are densities, so they can exceed 1; dynamic programming allows this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np

from hmt_ros.core import elementary
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.gaussian_pairs import pair_log_densities
from hmt_ros.inference.linear_algebra import log_sum_exp, product
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics


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
        """Number T of times."""
        return len(self.nodes)


def embedded_network(
    mixtures: Sequence[GaussianMixture],
    dynamics: LinearGaussianDynamics,
    intervals: Array,
) -> EmbeddedNetwork:
    """The network of Gaussian modes, in closed form.

    Args:
        intervals: (T-1,) between successive times, s.
    """
    d, n = dynamics.dimension, dynamics.state_dimension
    begin = np.concatenate([[0], np.cumsum([len(mixture) for mixture in mixtures])])
    means = np.concatenate([mixture.means for mixture in mixtures])
    covariances = np.concatenate([mixture.covariances for mixture in mixtures])
    different, which = np.unique(intervals, return_inverse=True)

    # Predicted mean and covariance of every mode at the next time.
    predicted, spread = np.empty_like(means), np.empty_like(covariances)
    for i, interval in enumerate(different):
        a, q = dynamics.transition(float(interval))
        own, other = a[:d, :d], a[:d, d:]
        noise = (
            q[:d, :d] + product(product(other, dynamics.unknown_velocity), other.T) if n > d else q
        )
        at: Any = slice(0, begin[-2])
        if len(different) > 1:
            at = np.repeat(which == i, np.diff(begin[:-1])).nonzero()[0]
        predicted[at] = product(means[at], own.T)
        spread[at] = product(product(own, covariances[at]), own.T) + noise

    # Evaluate all pairs at once: modes of the same time, and modes of successive times.
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
    each_node = np.split(node_values, np.cumsum([pairs.shape[1] for pairs in within]))
    each_link = np.split(link_values, np.cumsum([pairs.shape[1] for pairs in across]))
    return EmbeddedNetwork(
        tuple(
            _node_values(mixture.weights, values, pairs)
            for mixture, values, pairs in zip(mixtures, each_node, within)
        ),
        tuple(
            values.reshape(len(left), len(right))
            for (left, right), values in zip(pairwise(mixtures), each_link)
        ),
    )


def _node_values(weights: Array, densities: Array, pairs: Index) -> Array:
    """Log node values (K,): log sums over weighted modes, from log densities of pairs (2, P)."""
    row, column = pairs
    log = np.empty((len(weights), len(weights)))
    log[row, column] = log[column, row] = densities
    # scipy's logsumexp, without its overhead for axes and signs.
    top = log.max(1, keepdims=True)
    return np.asarray(elementary.log(product(elementary.exp(log - top), weights)) + top[:, 0])


@lru_cache(maxsize=256)
def _pairs_within(count: int) -> Index:
    return np.array(np.triu_indices(count), dtype=np.int64)


@lru_cache(maxsize=256)
def _pairs_across(before: int, after: int) -> Index:
    return np.indices((before, after)).reshape(2, -1)


@dataclass(frozen=True, eq=False)
class Paths:
    """Paths through the layers.

    Attributes:
        nodes: (P, T) index of the node at each time.
        log_values: (P,) sum of the log values of nodes and links.
    """

    nodes: Index
    log_values: Array

    def __len__(self) -> int:
        return len(self.log_values)

    def __getitem__(self, index: Index) -> Paths:
        """Select paths, in the order of the index."""
        return Paths(self.nodes[index], self.log_values[index])

    @property
    def weights(self) -> Array:
        """Probabilities (P,) of the paths, normalised to sum 1."""
        return np.asarray(elementary.exp(self.log_values - log_sum_exp(self.log_values)))


def k_best_paths(network: EmbeddedNetwork, k: int) -> Paths:
    """The k best paths from every first to every last node, best first.

    The cost is O(K^3 k T log k). If fewer than k paths connect two nodes, all of these are
    returned.

    Raises:
        ValueError: k < 1.
    """
    if k < 1:
        raise ValueError(f'k must be at least 1, saw {k}')
    sources = len(network.nodes[0])
    # best has shape (sources, nodes, ranks); a missing path has value -inf.
    best = np.where(np.eye(sources, dtype=bool), network.nodes[0][:, None], -np.inf)[:, :, None]
    # Predecessor of each kept path, and number of kept paths per source and node.
    back: list[tuple[Index, int]] = []
    for t, links in enumerate(network.links):
        before, after = links.shape
        ranks = best.shape[2]
        each = (best[:, :, :, None] + links[None, :, None, :]).reshape(sources, -1, after)
        if k == 1:
            chosen = each.argmax(1)[:, None]
        else:
            wanted = min(k, before * ranks)
            chosen = np.argsort(-each, axis=1, kind='stable')[:, :wanted]
        best = np.take_along_axis(each, chosen, axis=1).transpose(0, 2, 1)
        best = best + network.nodes[t + 1][None, :, None]
        back.append((chosen.transpose(0, 2, 1) + 0, ranks))
    source, node, rank = np.nonzero(np.isfinite(best))
    values = best[source, node, rank]
    order = np.argsort(-values, kind='stable')
    source, node, rank = source[order], node[order], rank[order]
    nodes = np.empty((len(order), network.times), dtype=np.intp)
    nodes[:, -1] = node
    for t, (kept, ranks) in reversed([*enumerate(back)]):
        flat = kept[source, nodes[:, t + 1], rank]
        nodes[:, t], rank = flat // ranks, flat % ranks
    return Paths(nodes, values[order])


def diverse_subset(paths: Paths, count: int, penalty: float = 2.0) -> Paths:
    """Probable paths that differ from each other, in the order of selection.

    Each selected path maximises its log value minus a penalty. At every time the penalty is
    proportional to the share of the selected paths that visit the same node [after Batra et al.,
    Diverse M-Best, ECCV 2012]. Without a penalty this gives the best paths.

    Raises:
        ValueError: count < 1.
    """
    if count < 1:
        raise ValueError(f'count must be at least 1, saw {count}')
    if count >= len(paths):
        return paths[np.argsort(-paths.log_values, kind='stable')]
    times = paths.nodes.shape[1]
    visits = np.zeros((times, int(paths.nodes.max()) + 1))
    at = np.arange(times)
    left = np.ones(len(paths), dtype=bool)
    chosen: list[int] = []
    for number in range(count):
        agreement = visits[at, paths.nodes].sum(1) / max(number, 1)
        score = np.where(left, paths.log_values - penalty * agreement, -np.inf)
        one = int(np.argmax(score))
        chosen.append(one)
        left[one] = False
        visits[at, paths.nodes[one]] += 1.0
    return paths[np.array(chosen, dtype=np.intp)]
