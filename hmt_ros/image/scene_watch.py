"""Whether the camera still sees the scene from where the background was taken.

    r(s) = normalised cross-correlation of |grad background| with |grad image|, shifted by s

on images that are `WIDTH` px wide, for shifts of up to `REACH`. The maximum is at s = 0 as long as
the camera has not moved, whoever walks in front of it, and whatever the light does: edges stay
where they are. It is elsewhere after a bump; after a larger one nothing fits.
"""

from __future__ import annotations

import cv2
import numpy as np

from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference.arrays import Array, Image

WIDTH, REACH = 320, 24
# Gradients count no more than this; Gaussian before the derivative, px.
STRONGEST, SMOOTHING = 200.0, 1.0
# One image in so many is looked at, and so many in a row must agree.
EVERY, AGREEING = 10, 2
# Least correlation that says something, and by how much it exceeds that of no shift.
LEAST, MARGIN = 0.3, 0.05
# Below this fraction of the first correlation without a shift the scene is another.
LEFT = 0.4


class SceneWatch:
    """Watches the scene of a camera that is to stand still.

    Attributes:
        moved: whether the camera has moved since the background was taken.
        shift: how far the scene lies from where the background has it, px; NaN: farther than can
            be told.
    """

    def __init__(self) -> None:
        self.moved = False
        self.shift = 0.0
        self._count = self._signs = 0
        self._seen: tuple[BackgroundModel | None, int] = None, 0
        self._edges: Array | None = None
        self._usual = 0.0

    def look(self, image: Image, background: BackgroundModel) -> None:
        """Takes the next image (H, W, 3), before a background that is known."""
        self._count += 1
        if self._count % EVERY != 1 or background.unknown is not None:
            return
        if self._seen != (background, background.frames):
            self._seen = background, background.frames
            self._edges, self._usual, self._signs = _edges(background.empty), 0.0, 0
        assert self._edges is not None
        shift, best, here = _correlation(self._edges, _edges(image))
        self._usual = self._usual or here
        elsewhere = best >= LEAST and best - here >= MARGIN
        another = self._usual >= LEAST and here < LEFT * self._usual
        self._signs = self._signs + 1 if elsewhere or another else 0
        self.moved = self._signs >= AGREEING
        self.shift = shift * image.shape[1] / WIDTH if elsewhere else np.nan if another else 0.0


def _edges(image: Image) -> Array:
    """Lengths (h, w) of the gradients of an image (H, W, 3), at `WIDTH`."""
    height = max(round(image.shape[0] * WIDTH / image.shape[1]), 2 * REACH + 8)
    small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), SMOOTHING)
    lengths = np.hypot(cv2.Sobel(small, cv2.CV_32F, 1, 0), cv2.Sobel(small, cv2.CV_32F, 0, 1))
    strongest: Array = np.minimum(lengths.max(axis=2), STRONGEST)
    return strongest


def _correlation(background: Array, image: Array) -> tuple[float, float, float]:
    """The shift with the best correlation, px; that correlation; and that of no shift."""
    inner = background[REACH:-REACH, REACH:-REACH]
    found = np.nan_to_num(cv2.matchTemplate(image, inner, cv2.TM_CCOEFF_NORMED))
    row, column = np.unravel_index(int(found.argmax()), found.shape)
    shift = float(np.hypot(row - REACH, column - REACH))
    return shift, float(found[row, column]), float(found[REACH, REACH])
