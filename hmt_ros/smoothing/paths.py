"""Most probable paths through the embedded network (VMS 4).

Exact max-product over the layers, for all sources at once. The values of nodes and links are
densities and may exceed 1; dynamic programming over layers needs no bound on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.smoothing.embedded_network import EmbeddedNetwork


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
        """Some of the paths, in the order of the index."""
        return Paths(self.nodes[index], self.log_values[index])

    @property
    def weights(self) -> Array:
        """Probabilities (P,) of the paths among themselves."""
        result: Array = np.exp(self.log_values - logsumexp(self.log_values))
        return result


def most_probable_paths(network: EmbeddedNetwork) -> Paths:
    """The best path from every first to every last node, K_1 x K_T paths, the best one first."""
    return k_best_paths(network, 1)


def k_best_paths(network: EmbeddedNetwork, k: int) -> Paths:
    """The k best paths from every first to every last node, the best of all first.

    O(K^3 k T log k); there are fewer where fewer exist.

    Raises:
        ValueError: k < 1.
    """
    if k < 1:
        raise ValueError(f'k must be at least 1, saw {k}')
    sources = len(network.nodes[0])
    # best (sources, nodes, rank); a path that does not exist has value -inf.
    best = np.where(np.eye(sources, dtype=bool), network.nodes[0][:, None], -np.inf)[:, :, None]
    back: list[Index] = []
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
        back.append(chosen.transpose(0, 2, 1) + 0)
    source, node, rank = np.nonzero(np.isfinite(best))
    values = best[source, node, rank]
    order = np.argsort(-values, kind='stable')
    source, node, rank = source[order], node[order], rank[order]
    nodes = np.empty((len(order), network.times), dtype=np.intp)
    nodes[:, -1] = node
    for t in range(len(back) - 1, -1, -1):
        flat = back[t][source, nodes[:, t + 1], rank]
        ranks = min(k, _ranks_at(network, t, k))
        nodes[:, t], rank = flat // ranks, flat % ranks
    return Paths(nodes, values[order])


def paths_through_nodes(network: EmbeddedNetwork) -> Paths:
    """For every node at every time the best path through it; without repetitions, best first.

    The paths between ends agree in the middle of a long sequence: they tell which trajectories
    there are, but not what else a single pose may have been.
    """
    forward, ahead = [network.nodes[0]], []
    for links, nodes in zip(network.links, network.nodes[1:]):
        each = forward[-1][:, None] + links
        ahead.append(each.argmax(0))
        forward.append(each.max(0) + nodes)
    backward, behind = [np.zeros(len(network.nodes[-1]))], []
    for links, nodes in zip(network.links[::-1], network.nodes[:0:-1]):
        each = links + nodes + backward[-1]
        behind.append(each.argmax(1))
        backward.append(each.max(1))
    backward, behind = backward[::-1], behind[::-1]
    found, values = [], []
    for t, (before, after) in enumerate(zip(forward, backward)):
        paths = np.empty((len(before), network.times), dtype=np.intp)
        paths[:, t] = np.arange(len(before))
        for u in range(t, 0, -1):
            paths[:, u - 1] = ahead[u - 1][paths[:, u]]
        for u in range(t, network.times - 1):
            paths[:, u + 1] = behind[u][paths[:, u]]
        found.append(paths)
        values.append(before + after)
    return distinct_paths(Paths(np.concatenate(found), np.concatenate(values)))


def distinct_paths(paths: Paths) -> Paths:
    """Without repetitions, the best first."""
    _, first = np.unique(paths.nodes, axis=0, return_index=True)
    first = first[np.isfinite(paths.log_values[first])]
    return paths[first[np.argsort(-paths.log_values[first], kind='stable')]]


def _ranks_at(network: EmbeddedNetwork, t: int, k: int) -> int:
    """How many paths per source and node are kept at time t."""
    ranks = 1
    for links in network.links[:t]:
        ranks = min(k, ranks * len(links))
    return ranks


def visiting_probabilities(network: EmbeddedNetwork, paths: Paths) -> tuple[Array, ...]:
    """How probably the paths from each source visit each node (VMS fig. 2), T arrays (K_1, K_t).

    Of the paths that start from the same first node, the sum of the probabilities of those through
    a node over that of all. Rows of sources without paths are zero.
    """
    sources = len(network.nodes[0])
    weights = np.zeros(len(paths))
    for source in range(sources):
        at = paths.nodes[:, 0] == source
        if at.any():
            weights[at] = np.exp(paths.log_values[at] - logsumexp(paths.log_values[at]))
    result = []
    for t, nodes in enumerate(network.nodes):
        table = np.zeros((sources, len(nodes)))
        np.add.at(table, (paths.nodes[:, 0], paths.nodes[:, t]), weights)
        result.append(table)
    return tuple(result)


def diverse_subset(paths: Paths, count: int, penalty: float = 2.0) -> Paths:
    """Paths that are probable and differ from each other, in the order of choice.

    Greedily the path with the greatest log value less a penalty, for every time, on the share of
    paths already chosen that visit the same node there [after Batra et al., Diverse M-Best, ECCV
    2012]. With no penalty these are the best paths.

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
