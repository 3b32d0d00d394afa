"""The skeleton as `core/residuals.h` reads it, which sums the residuals of all terms."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros import core
from hmt_ros.body.skeleton import Skeleton

# Columns of a list of residuals: segment, point (3), derivative (3), pull, curvature.
RECORDED: int = core.RECORDED


class Tree(NamedTuple):
    """The skeleton as the compiled code reads it.

    Attributes:
        parents: (S,) segment above; -1: none.
        dof_segments: (d,) segment of each degree of freedom.
        dof_parents: (d,) the degree of freedom before it on the path from the root; -1: none.
        dof_is_rotation: (d,).
    """

    parents: NDArray[np.int64]
    dof_segments: NDArray[np.int64]
    dof_parents: NDArray[np.int64]
    dof_is_rotation: NDArray[np.bool_]


@lru_cache(maxsize=16)
def tree_of(skeleton: Skeleton) -> Tree:
    """The compiled code's view of a skeleton."""
    last_of: list[int] = []  # the last degree of freedom on the path to each segment
    before = np.full(skeleton.dimension, -1)
    for segment, parent in enumerate(skeleton.parents):
        last = last_of[parent] if parent >= 0 else -1
        for dof in skeleton.segment_dofs[segment]:
            before[dof] = last
            last = dof
        last_of.append(last)
    return Tree(
        np.array(skeleton.parents, dtype=np.int64),
        np.array(skeleton.dof_segments, dtype=np.int64),
        before.astype(np.int64),
        np.array(skeleton.dof_is_rotation),
    )
