"""The best combinations of one alternative per chain, best first (KJS 3).

Given the trunk, the cost of a combination is a sum with one term per chain: of log priors for the
flips of whole bodies (`whole_body_flips`), of changes in energy for the tracker, which takes the
best in compiled code (`limb_products`). `least_sums` takes the best of them.

`distinct_poses` compares poses by their joint positions, not by their angles: a rotation has two
triples of Euler angles, Rx(a) Ry(b) Rz(c) = Rx(a + pi) Ry(pi - b) Rz(c + pi), every angle has its
turns of 2 pi, and the twist of a straight limb moves nothing that is seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from hmt_ros.inference.arrays import Array, Index


def least_sums(
    costs: Sequence[Array],
    count: int,
    allowed: Mapping[tuple[int, int], NDArray[np.bool_]] | None = None,
) -> tuple[Array, Index]:
    """The `count` choices of one entry per list with the least sums, least first.

    List by list, only the `count` best sums so far go on: what is among the best of all lists is
    among the best of the first few. Where pairs are ruled out this does not hold, and all sums go
    on that they allow. Equal sums stand in the order of the lists.

    Args:
        costs: C lists of costs, (A,) each.
        count: maximum number of choices.
        allowed: (A, A') for pairs i < j of lists, which entries go together; all, where missing.

    Returns:
        sums (n,) and choices (n, C).
    """
    tables = dict(allowed or {})
    sums, picks = np.zeros(1), np.zeros((1, 0), dtype=np.intp)
    for c, cost in enumerate(costs):
        total = (sums[:, None] + cost).ravel()
        order = np.argsort(total, kind='stable')[: None if tables else count]
        before, last = np.divmod(order, len(cost))
        for (i, j), table in tables.items():
            if j == c:
                fits = table[picks[before, i], last]
                order, before, last = order[fits], before[fits], last[fits]
        sums, picks = total[order], np.column_stack([picks[before], last])
    return sums[:count], picks[:count]


class Distinct(NamedTuple):
    """Poses that represent all of a set.

    Attributes:
        kept: (K,) indices, in the order of the poses.
        owner: (N,) position in `kept` of the representative of each pose; -1 where the maximum
            number was reached before.
    """

    kept: Index
    owner: Index


def distinct_poses(joints: ArrayLike, apart: float, most: int | None = None) -> Distinct:
    """Poses that differ from every earlier one.

    The distance of two poses is that of the joint that is furthest apart. A pose that is nearer
    than `apart` to one that is kept is represented by the nearest of these. So the first, best
    poses represent later ones.

    Args:
        joints: (N, J, 3) joint positions of the poses, m.
        apart: distance from which on two poses are distinct, m.
        most: maximum number of poses that are kept; None keeps all that are distinct.

    Raises:
        ValueError: joints of another shape.
    """
    points = np.ascontiguousarray(joints, dtype=np.float64)
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f'joints must have shape (N, J, 3), saw {points.shape}')
    flat = points.reshape(len(points), 3 * points.shape[1])
    return Distinct(*keep_distinct(flat, float(apart), len(flat) if most is None else int(most)))


@njit(cache=True, nogil=True)
def keep_distinct(points, apart, most):  # type: ignore[no-untyped-def]
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
