"""Select: a few hypotheses that represent all hypotheses (KJS figure 4, step 5).

    min over S, |S| = K:   sum_i w_i min_{s in S} d(i, s)

The K heaviest hypotheses would be near copies of the heaviest. Instead, K hypotheses are chosen
greedily, heaviest first, to minimise the expected distance from a hypothesis to the nearest kept
hypothesis. d is the mean of the capped joint distances; hypotheses closer than a minimum are
treated as equal. The weight of a dropped hypothesis is added to the nearest kept hypothesis.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from hmt_ros.core import choose_representatives, keep_apart
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.tracking.settings import MAX_JOINT_DISTANCE


class Kept(NamedTuple):
    """Selected hypotheses, which represent all other hypotheses.

    Attributes:
        chosen: (K,) indices of the selected hypotheses, in the order of selection.
        owner: (N,) position in `chosen` of the representative of each hypothesis.
        log_weights: (K,) log weights of the groups.
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
    """Selects the hypotheses to keep.

    Args:
        joints: (N, J, 3) joint positions from which distances are computed, m.
        log_weights: (N,) log weights.
        count: maximum number of kept hypotheses, K.
        same: mean distance below which two hypotheses are treated as equal, m.
        cap: maximum distance of a joint, to which larger distances are clipped, m.
        first: indices of hypotheses that are always kept, after the heaviest.
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
    """Indices of hypotheses at distinct optima, heaviest first.

    Args:
        joints: (N, J, 3) joint positions from which distances are computed, m.
        log_weights: (N,) log weights.
        same: mean distance below which two hypotheses are treated as equal, m.
    """
    order, kept = np.argsort(-log_weights, kind='stable'), np.empty(len(joints), dtype=np.intp)
    count = keep_apart(np.ascontiguousarray(joints, dtype=np.float64), order, same, kept)
    return kept[:count]
