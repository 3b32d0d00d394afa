"""Pairs of edges across a silhouette: histograms of their distance and of the angle between them.

After the pairwise edge histograms of BME 3. A silhouette has edges on its outlines only, so pairs
are taken there, and of these the ones whose connection runs inside: both sides of a limb or of the
trunk, and the ends of what is straight. Thickness and bend of limbs show, wherever the limb is.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

DISTANCES, ANGLES = 6, 8
RADII = (1 / 8, 3.0)  # of the mean distance between points, log scale
BETWEEN = (0.5, 0.25, 0.75)  # places on the connection that must be inside
SIZE = DISTANCES * ANGLES


def edge_pairs(points: Array, directions: Array, mask: Bytes) -> Array:
    """Shares (48,) of pairs of edges by distance and angle between them, of those seen inside.

    Not changed by shift, size or rotation.

    Args:
        points: (N, 2) on the outlines, px.
        directions: (N,) in which the outlines run, rad.
        mask: (h, w) that the points are in.
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
    scale = DISTANCES / np.log(high / low)
    ring = np.log(np.maximum(distance[inside], 1e-9) / (mean * low)) * scale
    turn = np.abs((directions[second] - directions[first])[inside])
    turn = np.minimum(turn % (2 * np.pi), -turn % (2 * np.pi))  # 0 to pi
    bins = np.clip(ring, 0, DISTANCES - 1).astype(np.intp) * ANGLES
    bins += np.minimum(turn * (ANGLES / np.pi), ANGLES - 1).astype(np.intp)
    counts: Array = np.bincount(bins, minlength=SIZE).astype(np.float64)
    return counts / max(float(counts.sum()), 1.0)


@lru_cache(maxsize=4)
def _pairs(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    first, second = np.triu_indices(count, 1)
    return first, second
