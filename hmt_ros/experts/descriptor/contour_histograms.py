"""Histograms of points along the outline of a silhouette: shape contexts and edge pairs (BME 3).

The shape context of a point is the histogram of the positions of the other points relative to it:
5 radial bins on a log scale from 1/8 to 3 of the mean distance, and 12 angular bins. K-means over
all contexts of a training set gives a codebook. A silhouette is the sum of the votes of its
contexts for their nearest centres, weighted by inverse distance.

An edge pair is two points whose connection lies inside the silhouette: the two sides of a limb or
of the trunk, or the two ends of a straight part. The histogram of the distances and angles of edge
pairs shows how thick and how bent limbs are, wherever they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.clustering import k_means, squared_distances

Bytes = NDArray[np.uint8]

RADIAL, ANGULAR = 5, 12
RADII = (1 / 8, 3.0)  # of the mean distance between points
VOTES = 4  # centres that a context votes for
LEAST_DISTANCE = 1e-3  # a context that is nearer to a centre votes as if it were this far away

PAIR_DISTANCES, PAIR_ANGLES = 6, 8
PAIR_BINS = PAIR_DISTANCES * PAIR_ANGLES
BETWEEN = (0.5, 0.25, 0.75)  # positions along a connection that must lie inside


def shape_contexts(points: Array) -> Array:
    """Shape contexts (N, 60) of points (N, 2): the share of the other points in each bin.

    They do not change with translation or scale; they change with rotation. Points beyond the
    smallest and largest radius fall into no bin.
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
    """Centres (C, 60) of the square roots of shape contexts.

    The distance between square roots of shares is Hellinger's, in which the fullest bins do not
    dominate.

    Raises:
        ValueError: the centres have another shape or are not finite.
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
        """The codebook of contexts (N, 60); the same contexts and seed give the same centres.

        Raises:
            ValueError: there are fewer contexts than centres, or some are not finite.
        """
        if len(contexts) < count:
            raise ValueError(f'{len(contexts)} shape contexts for {count} centres: give more masks')
        if not np.isfinite(contexts).all():
            raise ValueError('shape contexts must be finite')
        return cls(k_means(np.sqrt(contexts), count, np.random.default_rng(seed))[0])

    def histogram(self, contexts: Array) -> Array:
        """Votes (C,) of contexts (N, 60): a histogram that sums to 1."""
        squared = squared_distances(np.sqrt(contexts), self.centres)
        votes = min(VOTES, len(self.centres))
        nearest = np.argpartition(squared, votes - 1, axis=1)[:, :votes]
        distance = np.sqrt(np.take_along_axis(squared, nearest, axis=1))
        weight = 1.0 / np.maximum(distance, LEAST_DISTANCE)
        weight /= weight.sum(1, keepdims=True)
        counts = np.bincount(nearest.ravel(), weight.ravel(), len(self.centres))
        return np.asarray(counts / len(contexts), dtype=np.float64)


def edge_pairs(points: Array, directions: Array, mask: Bytes) -> Array:
    """Histogram (48,) of the distances and angles of edge pairs; it sums to 1.

    It does not change with translation, scale or rotation.

    Args:
        points: (N, 2) on the outlines, px.
        directions: (N,) of the outlines at the points, rad.
        mask: (h, w) the silhouette.
    """
    first, second = _pairs(len(points))
    start = points[first]
    off = points[second] - start
    distance = np.sqrt((off * off).sum(1))
    mean = max(float(distance.mean()), 1e-9)
    height, width = mask.shape
    inside = np.ones(len(off), dtype=bool)
    for share in BETWEEN:  # smoothed outlines never leave the mask
        column, row = (start + share * off + 0.5).astype(np.int32).T
        inside &= mask[np.minimum(row, height - 1), np.minimum(column, width - 1)] > 0
    low, high = RADII
    scale = PAIR_DISTANCES / np.log(high / low)
    ring = np.log(np.maximum(distance[inside], 1e-9) / (mean * low)) * scale
    turn = np.abs((directions[second] - directions[first])[inside])
    turn = np.minimum(turn % (2 * np.pi), -turn % (2 * np.pi))  # 0 to pi
    bins = np.clip(ring, 0, PAIR_DISTANCES - 1).astype(np.intp) * PAIR_ANGLES
    bins += np.minimum(turn * (PAIR_ANGLES / np.pi), PAIR_ANGLES - 1).astype(np.intp)
    counts: Array = np.bincount(bins, minlength=PAIR_BINS).astype(np.float64)
    return counts / max(float(counts.sum()), 1.0)


@lru_cache(maxsize=4)
def _pairs(count: int) -> tuple[Index, Index]:
    first, second = np.triu_indices(count, 1)
    return first, second
