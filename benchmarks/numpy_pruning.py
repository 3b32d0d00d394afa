"""Greedy choice of hypotheses in vectorised numpy: what the compiled one is measured against."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def choose(
    joints: Array, weights: Array, count: int, same: float = 0.02, cap: float = 0.3
) -> tuple[Index, Index]:
    """Chosen hypotheses (K,) and who stands for each (N,); see `hmt_ros.tracking.selection`."""
    offsets = joints[:, None] - joints[None]
    lengths = np.sqrt(np.einsum('abjx,abjx->abj', offsets, offsets))
    distance = np.maximum(np.minimum(lengths, cap).mean(2) - same, 0.0)
    np.fill_diagonal(distance, 0.0)
    nearest = np.full(len(joints), cap)
    owner = np.zeros(len(joints), dtype=np.intp)
    chosen: list[int] = []
    while len(chosen) < min(count, len(joints)):
        gains = weights @ np.maximum(nearest[:, None] - distance, 0.0)
        best = int(np.argmax(gains if chosen else weights))
        if chosen and not gains[best] > 0:
            break
        closer = distance[:, best] < nearest
        nearest = np.where(closer, distance[:, best], nearest)
        owner[closer] = len(chosen)
        owner[best] = len(chosen)
        chosen.append(best)
    return np.array(chosen, dtype=np.intp), owner
