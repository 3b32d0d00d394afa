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

from hmt_ros.core import choose_representatives, keep_apart
from hmt_ros.inference.arrays import Array, Index
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
    n = len(log_weights)
    most = min(count, n)
    chosen, owner, groups = np.empty(most, np.intp), np.empty(n, np.intp), np.empty(most)
    kept = choose_representatives(
        np.ascontiguousarray(joints, dtype=np.float64),
        np.ascontiguousarray(log_weights, dtype=np.float64),
        same,
        cap,
        np.array(first, dtype=np.intp),
        chosen,
        owner,
        groups,
    )
    return Kept(chosen[:kept], owner, groups[:kept])


def distinct_hypotheses(joints: Array, log_weights: Array, same: float) -> Index:
    """Indices of hypotheses without those that have come to the same optimum, heaviest first.

    Args:
        joints: (N, J, 3) positions that distances are taken of, m.
        log_weights: (N,).
        same: mean distance below which two hypotheses are one, m.
    """
    order, kept = np.argsort(-log_weights, kind='stable'), np.empty(len(joints), dtype=np.intp)
    count = keep_apart(np.ascontiguousarray(joints, dtype=np.float64), order, same, kept)
    return kept[:count]
