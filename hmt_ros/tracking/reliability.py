"""How far the silhouette is believed on each segment of the body.

    recall_s <- recall_s + gain (m_s - recall_s)    m_s: share of the visible points of segment s
                                                    that lie in the foreground
    belief_s = clip((recall_s - low) / (high - low), 0, 1)

Clothes in the colours of the scene are no foreground where the person is: the silhouette has holes,
and what forbids limbs outside it would move them. Where a segment is seen, and how much of it has
been foreground, is known from the images before.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.image.texture import Textures
from hmt_ros.inference.arrays import Array, Mask

LOW, HIGH = 0.45, 0.8
# Of all of the person; below it, what a silhouette shows is another shape.
LEAST = 0.6
# How far the recall follows that of the newest image.
GAIN = 0.05
# Fewer visible points of a segment than this say little.
FEWEST = 4


class SilhouetteRecall:
    """Share of each segment that the silhouette has shown.

    Args:
        segments: number of segments, S.
    """

    def __init__(self, segments: int) -> None:
        self._recall = np.ones(segments)
        self._total = 1.0
        self._begun = False

    @property
    def beliefs(self) -> Array:
        """(S,) from 0, nothing, to 1, all."""
        return np.clip((self._recall - LOW) / (HIGH - LOW), 0.0, 1.0)

    @property
    def believed(self) -> bool:
        """Whether silhouettes show enough of the person to be used at all."""
        return self._total >= LEAST

    def update(self, textures: Textures, row: int, foreground: Mask) -> None:
        """Takes in an image.

        Args:
            textures: of the modes, with the pixels that their points were seen at.
            row: of the mode that is believed.
            foreground: (H, W).
        """
        n = int(textures.counts[row])
        segments = textures.segments[row, :n]
        column, line = textures.pixels[row, :n].T.round().astype(np.intp)
        height, width = foreground.shape
        inside = (column >= 0) & (line >= 0) & (column < width) & (line < height)
        if not inside.any():
            return
        hit = foreground[line[inside], column[inside]]
        count = np.bincount(segments[inside], minlength=len(self._recall))
        found = np.bincount(segments[inside], weights=hit, minlength=len(self._recall))
        seen = count > 0
        gain = np.minimum(count / FEWEST, 1.0) * (GAIN if self._begun else 1.0)
        share = np.where(seen, found / np.maximum(count, 1), self._recall)
        self._recall += gain * (share - self._recall)
        total = float(found.sum() / count.sum())
        self._total += (GAIN if self._begun else 1.0) * (total - self._total)
        self._begun = True
