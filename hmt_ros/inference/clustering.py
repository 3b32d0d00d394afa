"""K-means: Lloyd's iterations from k-means++ seeds.

min over c_1 ... c_K of sum_n min_k |x_n - c_k|^2
"""

from __future__ import annotations

import numpy as np

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product


def k_means(
    points: Array, count: int, rng: np.random.Generator, iterations: int = 25
) -> tuple[Array, Index]:
    """Cluster points (N, p) into at most `count` clusters, fewer if fewer points are distinct.

    Returns:
        Centres (K, p) and labels (N,). A cluster that loses all its points keeps its centre.
    """
    centres = points[spread_points(points, count, rng)]
    for _ in range(iterations):
        labels = squared_distances(points, centres).argmin(1)
        sizes = np.bincount(labels, minlength=len(centres))[:, None]
        sums = [np.bincount(labels, column, len(centres)) for column in points.T]
        centres = np.where(sizes > 0, np.stack(sums, axis=1) / np.maximum(sizes, 1), centres)
    return centres, labels


def spread_points(points: Array, count: int, rng: np.random.Generator) -> Index:
    """Indices of at most `count` points, spread over the data (N, p).

    The seeds of k-means++ [Arthur and Vassilvitskii, SODA 2007]: each point is drawn with a
    probability proportional to its squared distance to the nearest selected point. Any first few of
    the selected points are spread over the data as well. Equal points are selected once.
    """
    chosen = [int(rng.integers(len(points)))]
    distance = np.full(len(points), np.inf)
    floor = 1e-12 * max(float((points**2).sum(1).max()), 1e-300)
    while len(chosen) < min(count, len(points)):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(1))
        distance[distance <= floor] = 0.0
        total = distance.sum()
        if total <= 0:
            break
        chosen.append(int(np.searchsorted(np.cumsum(distance), total * rng.random())))
    return np.array(chosen)


def smallest_columns(values: Array, count: int) -> Index:
    """Column indices (N, count), ascending, of the smallest values in each row of (N, M).

    Ties are broken by position, because numpy's own selection depends on the processor.
    """
    last = np.partition(values, count - 1, axis=1)[:, count - 1, None]
    below, tied = values < last, values == last
    tied &= tied.cumsum(1) <= count - below.sum(1, keepdims=True)
    return np.nonzero(below | tied)[1].reshape(-1, count)


def squared_distances(a: Array, b: Array) -> Array:
    """Squared distances (N, M) between points (N, p) and (M, p)."""
    result: Array = (a * a).sum(1)[:, None] - product(b, 2.0 * a.T).T + (b * b).sum(1)
    return np.maximum(result, 0.0, out=result)
