"""Which of many poses are distinct: by where their joints are, not by their angles.

A rotation has two triples of Euler angles, Rx(a) Ry(b) Rz(c) = Rx(a + pi) Ry(pi - b) Rz(c + pi),
every angle its turns of 2 pi, and the twist of a straight limb moves nothing that is seen. Two
poses are therefore one when no joint of theirs is further apart than a distance, whatever their
angles.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class Distinct(NamedTuple):
    """Poses that stand for all.

    Attributes:
        kept: (K,) indices, in the order of the poses.
        owner: (N,) position in `kept` of the pose that stands for each; -1: none, as there were
            enough before.
    """

    kept: Index
    owner: Index


def distinct_poses(joints: ArrayLike, apart: float, most: int | None = None) -> Distinct:
    """Poses that are not one with an earlier one.

    A pose is one with the nearest of those that are kept, in the distance of the joint that is
    furthest apart, if that is less than `apart`. Earlier poses stand for later ones: best first.

    Args:
        joints: (N, J, 3) of the poses, m.
        apart: distance of some joint that makes poses distinct, m.
        most: how many to keep at most; None: all.

    Raises:
        ValueError: joints of another shape.
    """
    points = np.ascontiguousarray(joints, dtype=np.float64)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f'joints must have shape (N, J, 3), saw {points.shape}')
    flat = points.reshape(len(points), 3 * points.shape[1])
    return Distinct(*_distinct(flat, float(apart), len(flat) if most is None else int(most)))


@njit(cache=True, nogil=True)
def _distinct(points, apart, most):  # type: ignore[no-untyped-def]
    """Indices of the poses (N, 3 J) that are kept, and which stands for each."""
    n = len(points)
    kept, owner = np.empty(n, np.int64), np.full(n, -1)
    count = 0
    for i in range(n):
        least = apart * apart
        for place in range(count):
            k = kept[place]
            gap = 0.0
            for j in range(0, points.shape[1], 3):
                x = points[k, j] - points[i, j]
                y = points[k, j + 1] - points[i, j + 1]
                z = points[k, j + 2] - points[i, j + 2]
                gap = max(gap, x * x + y * y + z * z)
                if gap >= least:
                    break
            if gap < least:
                owner[i], least = place, gap
        if owner[i] < 0 and count < most:
            kept[count], owner[i] = i, count
            count += 1
    return kept[:count], owner
