"""Select: which of many hypotheses to keep, few that stand for all (KJS figure 4, step 5).

    min over S, |S| = K:   sum_i w_i min_{s in S} d(i, s)

Keeping the K heaviest modes keeps near copies of the heaviest one. Here the K are chosen that leave
the least expected distance from a hypothesis to the nearest kept one, greedily, heaviest first; d
is the mean distance of the joints, each capped; two hypotheses count as the same below a minimum.
Those dropped give their weight to the nearest kept one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.reduction import leaders
from hmt_ros.tracking.settings import MAX_JOINT_DISTANCE


class Kept(NamedTuple):
    """Hypotheses that stand for all.

    Attributes:
        chosen: (K,) indices, in the order in which they were chosen.
        owner: (N,) position in `chosen` of the hypothesis that stands for each.
        log_weights: (K,) of the groups.
    """

    chosen: Index
    owner: Index
    log_weights: Array


def choose_hypotheses(
    joints: Array,
    log_weights: Array,
    count: int,
    *,
    same: float,
    cap: float = MAX_JOINT_DISTANCE,
    first: Sequence[int] = (),
) -> Kept:
    """The hypotheses to keep.

    Args:
        joints: (N, J, 3) positions that distances are taken of, m.
        log_weights: (N,).
        count: how many to keep at most, K.
        same: mean distance below which two hypotheses are one, m.
        cap: largest distance that a joint counts with, m.
        first: hypotheses that are kept in any case, after the heaviest.
    """
    top = log_weights.max()
    weights = np.exp(log_weights - top)
    chosen, owner = _choose(
        np.ascontiguousarray(joints),
        weights / weights.sum(),
        count,
        same,
        cap,
        np.array(first, dtype=np.intp),
    )
    groups = np.array([np.logaddexp.reduce(log_weights[owner == k]) for k in range(len(chosen))])
    return Kept(chosen, owner, groups)


def distinct_hypotheses(joints: Array, log_weights: Array, same: float) -> Index:
    """Indices of hypotheses without those that have come to the same optimum, heaviest first.

    Args:
        joints: (N, J, 3) positions that distances are taken of, m.
        log_weights: (N,).
        same: mean distance below which two hypotheses are one, m.
    """

    def distances(i: int) -> Array:
        return np.asarray(np.linalg.norm(joints - joints[i], axis=2).mean(1))

    return leaders(log_weights, distances, same)


@njit(cache=True, nogil=True)
def _choose(joints, weights, count, same, cap, first):  # type: ignore[no-untyped-def]
    n, j = joints.shape[0], joints.shape[1]
    # One row a coordinate, so that the innermost loops run along memory; single precision is
    # micrometres here.
    rows = np.ascontiguousarray(joints.transpose(1, 2, 0)).astype(np.float32)
    distance = np.empty((n, n), np.float32)
    cap, same = np.float32(cap), np.float32(same)
    for a in range(n):
        total = distance[a]
        total[:] = 0.0
        for k in range(j):
            xs, ys, zs = rows[k, 0], rows[k, 1], rows[k, 2]
            xa, ya, za = xs[a], ys[a], zs[a]
            for b in range(n):
                x, y, z = xa - xs[b], ya - ys[b], za - zs[b]
                gap = np.sqrt(x * x + y * y + z * z)
                total[b] += gap if gap < cap else cap
        for b in range(n):
            total[b] = max(total[b] / np.float32(j) - same, np.float32(0.0))
    nearest = np.full(n, cap)
    gains = np.full(n, np.inf)
    chosen = np.empty(min(count, n), np.intp)
    owner = np.zeros(n, np.intp)
    kept = 0
    while kept < len(chosen):
        best, best_gain = -1, 0.0
        if kept == 0:
            best = int(np.argmax(weights))
        elif kept <= len(first):
            best = first[kept - 1]
        else:
            # Gains only shrink as more are kept: a candidate whose last gain is no larger than the
            # best of this round need not be looked at again.
            likely = int(np.argmax(gains))
            for turn in range(-1, n):
                c = likely if turn < 0 else turn
                if (
                    turn == likely
                    or nearest[c] == 0.0  # the same as one that is kept
                    or gains[c] < best_gain
                    or (gains[c] == best_gain and c > best >= 0)
                ):
                    continue
                gain = 0.0
                away = distance[c]
                for i in range(n):
                    gain += weights[i] * max(nearest[i] - away[i], 0.0)
                gains[c] = gain
                if gain > best_gain or (gain == best_gain and gain > 0.0 and c < best):
                    best, best_gain = c, gain
        if best < 0:
            break
        chosen[kept] = best
        for i in range(n):
            if distance[i, best] < nearest[i]:
                nearest[i] = distance[i, best]
                owner[i] = kept
        owner[best] = kept
        kept += 1
    return chosen[:kept], owner
