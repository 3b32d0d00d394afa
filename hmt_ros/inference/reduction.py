"""Reduction of mixtures to fewer components with approximately the same density.

Components are merged into one Gaussian that has their total weight, mean and covariance,

    w = sum_i w_i,   m = sum_i w_i m_i / w,   S = sum_i w_i (S_i + (m_i - m) (m_i - m)') / w,

so that the mean and the covariance of the whole mixture are preserved. The functions select the
components to merge in different ways:

- `merged_pairwise`: the pair of least cost, an upper bound on the Kullback-Leibler divergence due
  to its merge [Runnalls, IEEE TAES 2007], until few components are left,

      B(i, j) = 1/2 ((w_i + w_j) log|S_ij| - w_i log|S_i| - w_j log|S_j|);

- `merged_if_close`: the closest pair, until no pair is closer than a given distance;
- `reduced`: clusters of means, refined to lower a bound on the divergence between the large mixture
  and the small mixture [Goldberger and Roweis, NIPS 2004].
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.gaussian_pairs import pair_distances, pair_mixture_log_determinants
from hmt_ros.inference.linear_algebra import (
    cholesky,
    inverse,
    log_determinant,
    product,
    solve_triangular,
)
from hmt_ros.inference.mixture import GaussianMixture

# Share of the weight below which `reduced` drops a component.
NEGLIGIBLE_WEIGHT = 1e-8


def merged(mixture: GaussianMixture, share: Array) -> GaussianMixture:
    """Merge components into new components with the same moments.

    Args:
        share: (K, B) share of each component that each of B new components gets; empty new
            components are left out.
    """
    mass = share * mixture.weights[:, None]
    total = mass.sum(0)
    mass, total = mass[:, total > 0], total[total > 0]
    mass = mass / total
    means = product(mass.T, mixture.means)
    offsets = mixture.means[:, None] - means
    covariances = product(mass.T, mixture.covariances.reshape(len(mixture), -1)).reshape(
        -1, mixture.dimension, mixture.dimension
    )
    offsets = np.swapaxes(offsets, 0, 1)
    covariances += product(np.swapaxes(offsets * mass.T[:, :, None], 1, 2), offsets)
    return GaussianMixture(total, means, 0.5 * (covariances + np.swapaxes(covariances, 1, 2)))


def merged_pairwise(mixture: GaussianMixture, count: int) -> GaussianMixture:
    """Reduce to at most `count` components, by repeatedly merging the pair of least cost.

    Raises:
        ValueError: count < 1.

    Example:
        The merged component has the mean and the covariance of the mixture.

        >>> two = GaussianMixture([0.5, 0.5], [[-1.0], [1.0]], [[[0.25]], [[0.25]]])
        >>> merged_pairwise(two, 1).covariances
        array([[[1.25]]])
    """
    if count < 1:
        raise ValueError(f'k must be at least 1, saw {count}')
    return _merged_pairs(mixture, _divergence_costs, lambda left, _: left > count)


def merged_if_close(mixture: GaussianMixture, distance: float) -> GaussianMixture:
    """Merge the closest components until no pair is closer than a distance.

    Args:
        distance: distance of means, in standard deviations of the average covariance of the pair.
    """
    return _merged_pairs(mixture, _squared_distances, lambda _, cost: cost < distance**2)


# Function of weights, means, covariances, log determinants and pairs (P, 2): cost (P,) of merges.
PairCosts = Callable[[Array, Array, Array, Array, Index], Array]


def _merged_pairs(
    mixture: GaussianMixture, cost: PairCosts, go_on: Callable[[int, float], bool]
) -> GaussianMixture:
    """Merge the pair of least cost while go_on(number of components, least cost) is true."""
    mixture = mixture[mixture.weights > 0] if (mixture.weights == 0).any() else mixture
    w, m, s = (np.array(x) for x in (mixture.weights, mixture.means, mixture.covariances))
    count = len(w)
    if count < 2 or not go_on(count, 0.0):
        return mixture
    log_det = mixture.log_determinants.copy()
    costs, active = np.full((count, count), np.inf), np.ones(count, dtype=bool)
    pairs = np.stack(np.triu_indices(count, 1), axis=1)
    costs[pairs[:, 0], pairs[:, 1]] = cost(w, m, s, log_det, pairs)
    for left in range(count, 1, -1):
        i, j = (int(x) for x in np.unravel_index(int(np.argmin(costs)), costs.shape))
        if not go_on(left, float(costs[i, j])):
            break
        w[i], m[i], s[i] = _pair_moments(w, m, s, i, j)
        log_det[i] = log_determinant(s[i])
        active[j] = False
        costs[j, :] = costs[:, j] = np.inf
        others = np.flatnonzero(active & (np.arange(count) != i))
        if len(others):
            pairs = np.stack([np.minimum(i, others), np.maximum(i, others)], axis=1)
            costs[pairs[:, 0], pairs[:, 1]] = cost(w, m, s, log_det, pairs)
    return GaussianMixture(w[active], m[active], s[active])


def _pair_moments(w: Array, m: Array, s: Array, i: int, j: int) -> tuple[float, Array, Array]:
    """Return weight, mean and covariance of components i and j merged."""
    total = w[i] + w[j]
    a, b = w[i] / total, w[j] / total
    offset = m[j] - m[i]
    return total, m[i] + b * offset, a * s[i] + b * s[j] + a * b * np.outer(offset, offset)


def _divergence_costs(w: Array, m: Array, s: Array, log_det: Array, pairs: Index) -> Array:
    together = w[pairs].sum(1) * pair_mixture_log_determinants(m, s, w, pairs)
    return np.asarray(0.5 * (together - (w * log_det)[pairs].sum(1)))


def _squared_distances(w: Array, m: Array, s: Array, log_det: Array, pairs: Index) -> Array:
    return pair_distances(m, s, np.full(len(m), 0.5), pairs)


def reduced(mixture: GaussianMixture, count: int, iterations: int = 10) -> GaussianMixture:
    """Reduce to at most `count` components: cluster means, then lower the bound of `assignment`.

    The descent starts from the clusters or from pairwise merging, whichever has the lower bound.

    Raises:
        ValueError: count < 1.
    """
    if count < 1:
        raise ValueError(f'{count} components asked for, wanted at least 1')
    mixture = mixture.normalised()
    if len(mixture) <= count:
        return mixture
    large = mixture[mixture.weights > NEGLIGIBLE_WEIGHT].normalised()
    if len(large) <= count:
        return large
    starts = clustered(large, count), merged_pairwise(large, count)
    bound, share, small = min(
        ((*assignment(large, start), start) for start in starts), key=lambda one: one[0]
    )
    for _ in range(iterations):
        better = merged(large, share)
        new_bound, share = assignment(large, better)
        if bound - new_bound < 1e-4:
            break
        bound, small = new_bound, better
    return small


def clustered(mixture: GaussianMixture, count: int, iterations: int = 20) -> GaussianMixture:
    """Merge components by clusters of their means, in the metric of the mean covariance."""
    shares, d = mixture.weights / mixture.weights.sum(), mixture.dimension
    average = product(shares, mixture.covariances.reshape(len(mixture), -1)).reshape(d, d)
    points = solve_triangular(cholesky(average), mixture.means.T).T
    chosen = [int(np.argmax(mixture.weights))]
    for _ in range(count - 1):
        distance = ((points[:, None] - points[chosen]) ** 2).sum(2).min(1)
        chosen.append(int(np.argmax(mixture.weights * distance)))
    centres = points[chosen]
    labels: Index = np.full(len(points), -1)
    for _ in range(iterations):
        new = np.argmin(((points[:, None] - centres) ** 2).sum(2), axis=1)
        if (new == labels).all():
            break
        labels = new
        member = (labels[:, None] == np.arange(len(centres))) * mixture.weights[:, None]
        total = member.sum(0)
        full = total > 0
        centres[full] = product(member.T, points)[full] / total[full, None]
    share = (labels[:, None] == np.arange(len(centres))).astype(np.float64)
    return merged(mixture, share)


def assignment(large: GaussianMixture, small: GaussianMixture) -> tuple[float, Array]:
    """Bound on the divergence, nats, and assignment of large mixture to small mixture components.

    sum_a w_a min_b KL(large_a || small_b) >= KL(large || small) if the weight of each small
    component is the sum of the weights assigned to it, as after `merged` [Goldberger & Roweis, NIPS
    2004]. The shares (A, B) are 0 or 1.
    """
    divergences = gaussian_divergences(large, small)
    share = np.zeros_like(divergences)
    share[np.arange(len(large)), np.argmin(divergences, axis=1)] = 1.0
    return float(product(large.weights, divergences.min(axis=1))), share


def gaussian_divergences(a: GaussianMixture, b: GaussianMixture) -> Array:
    """KL(a_i || b_j), (A, B), between the components of two mixtures."""
    inverses = inverse(b.covariances)
    trace = product(a.covariances.reshape(len(a), -1), inverses.reshape(len(b), -1).T)
    offsets = a.means - b.means[:, None]
    square = (product(offsets, inverses) * offsets).sum(2).T
    log_det = b.log_determinants - a.log_determinants[:, None]
    return np.asarray(0.5 * (trace + square + log_det - a.dimension))
