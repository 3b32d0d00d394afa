"""Shape contexts, and a silhouette as the histogram of its contexts over a codebook (BME 3).

The context of a point on the outline is the histogram of where the other points lie: 5 radial bins
on a log scale from 1/8 to 3 of the mean distance, and 12 angular ones. All contexts of a training
set are clustered into a codebook, and a silhouette is the sum of the votes of its contexts for
their nearest centres, by inverse distance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RADIAL, ANGULAR = 5, 12
RADII = (1 / 8, 3.0)  # of the mean distance between points
VOTES = 4  # centres that a context votes for
DULLEST = 1e-3  # distance below which a context is a centre


def shape_contexts(points: Array) -> Array:
    """Shape contexts (N, 60) of points (N, 2): shares of the other points in each bin.

    Not changed by shift or size, changed by rotation. Points nearer than the smallest or further
    than the largest radius fall into no bin.
    """
    n = len(points)
    off = points[None] - points[:, None]  # (N, N, 2)
    distance = np.sqrt(off[..., 0] ** 2 + off[..., 1] ** 2)
    mean = distance.sum() / max(n * (n - 1), 1)
    low, high = RADII
    with np.errstate(divide='ignore'):
        radial = np.log(distance / (mean * low)) * (RADIAL / np.log(high / low))
    ring = np.floor(np.maximum(radial, -1.0)).astype(np.intp)
    angle = np.arctan2(off[..., 1], off[..., 0]) * (ANGULAR / (2 * np.pi))
    sector = np.floor(angle).astype(np.intp) % ANGULAR
    inside = (ring >= 0) & (ring < RADIAL)
    bins = np.arange(n)[:, None] * (RADIAL * ANGULAR) + ring * ANGULAR + sector
    counts = np.bincount(bins[inside], minlength=n * RADIAL * ANGULAR)
    return counts.reshape(n, RADIAL * ANGULAR) / max(n - 1, 1)


@dataclass(frozen=True, eq=False)
class ShapeContextCodebook:
    """Centres (C, 60) of shape contexts.

    Raises:
        ValueError: centres of another shape or that are not finite.
    """

    centres: Array

    def __post_init__(self) -> None:
        shape = self.centres.shape
        if len(shape) != 2 or shape[1] != RADIAL * ANGULAR or not np.isfinite(self.centres).all():
            raise ValueError(
                f'centres of shape contexts must be finite and (C, {RADIAL * ANGULAR}), saw {shape}'
            )

    @classmethod
    def of(cls, contexts: Array, count: int = 50, seed: int = 0) -> ShapeContextCodebook:
        """The codebook of contexts (N, 60), by k-means; the same contexts give the same centres.

        Raises:
            ValueError: fewer contexts than centres, or some that are not finite.
        """
        if len(contexts) < count:
            raise ValueError(f'{len(contexts)} shape contexts for {count} centres: give more masks')
        if not np.isfinite(contexts).all():
            raise ValueError('shape contexts must be finite')
        # Square roots of shares: distances between them are Hellinger's, which do not let the
        # fullest bins rule.
        return cls(cluster_centres(np.sqrt(contexts), count, seed))

    def histogram(self, contexts: Array) -> Array:
        """Votes (C,) of contexts (N, 60): a histogram that sums to 1."""
        squared = squared_distances(np.sqrt(contexts), self.centres)
        votes = min(VOTES, len(self.centres))
        nearest = np.argpartition(squared, votes - 1, axis=1)[:, :votes]
        distance = np.sqrt(np.take_along_axis(squared, nearest, axis=1))
        weight = 1.0 / np.maximum(distance, DULLEST)
        weight /= weight.sum(1, keepdims=True)
        counts = np.bincount(nearest.ravel(), weight.ravel(), len(self.centres))
        return np.asarray(counts / len(contexts), dtype=np.float64)


def cluster_centres(points: Array, count: int, seed: int = 0, sweeps: int = 25) -> Array:
    """Centres (count, p) of points (N, p) by k-means, from starts that are far apart (k-means++).

    A cluster that loses all its points keeps its centre.
    """
    rng = np.random.default_rng(seed)
    centres = np.empty((count, points.shape[1]))
    centres[0] = points[rng.integers(len(points))]
    nearest = squared_distances(points, centres[:1])[:, 0]
    for k in range(1, count):
        total = nearest.sum()
        chances = nearest / total if total > 0 else None
        centres[k] = points[rng.choice(len(points), p=chances)]
        nearest = np.minimum(nearest, squared_distances(points, centres[k : k + 1])[:, 0])
    for _ in range(sweeps):
        own = squared_distances(points, centres).argmin(1)
        sizes = np.bincount(own, minlength=count)
        order = np.argsort(own, kind='stable')
        present = np.flatnonzero(sizes)
        starts = np.concatenate([[0], np.cumsum(sizes[present])[:-1]])
        means = np.add.reduceat(points[order], starts) / sizes[present, None]
        moved = float(np.abs(means - centres[present]).max())
        centres[present] = means
        if moved < 1e-6:
            break
    return centres


def squared_distances(a: Array, b: Array) -> Array:
    """Squared distances (N, M) between points (N, p) and (M, p)."""
    result: Array = (a * a).sum(1)[:, None] - 2.0 * a @ b.T + (b * b).sum(1)
    return np.maximum(result, 0.0, out=result)
