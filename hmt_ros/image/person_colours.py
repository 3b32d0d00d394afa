"""The colours of a person: whether an image contains them, and whether the person has moved.

    p(M | colour) = h_M / (h_M + h_around)              ratio of two histograms
    B(x) = mean of p(M | colour) over a box at x        as large as the model
    score = (max B - elsewhere) / (here - elsewhere)

M are the pixels that the model covers. `here` is the usual value of B at the person, and
`elsewhere` the usual maximum of B over boxes that do not touch the person. The score is near 1 if
somebody in these colours is anywhere in the image, and near 0 in a room without the person. Colours
are not used as evidence if `here` and `elsewhere` are similar, or if most colours differ from
earlier images, because the lens is covered or the light has changed.

Missing colours are evidence against the person only if the scene has not changed since the colours
were learned:

    stillness = 1 - changed pixels beyond the model / (MAX_CHANGE pixels of the model), >= 0

After a change of the scene, such as a movement of the camera, `elsewhere` is no longer valid, and
the missing colours may be from an object that the model covered. Stillness is also low after the
person has moved out of the model. A new colour may belong to a person who has turned around.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import bin_colours, count_colours, elementary
from hmt_ros.image.person_shape import counted
from hmt_ros.inference.arrays import Array, Image, Mask

# Time constant of the means over learned images, s.
MEMORY_TIME = 2.0
# Interval between updates of the colours, which hardly change, s.
LEARNING_INTERVAL = 0.1
# Changed pixels beyond the model at which the scene counts as changed, as a fraction of all pixels
# beyond the model or, if fewer, of all others. The limit allows for the person's shadow.
MAX_CHANGE = 0.25
# Minimum difference between the probabilities `here` and `elsewhere` for colours to be evidence.
MIN_CONTRAST = 0.15
# Number of bins of a colour channel with values from 0 to 255.
BINS = 8
# Changed pixels above which the person has moved, and below which nothing has moved, as fractions
# of the model's pixels.
MOVED_FRACTION, UNMOVED_FRACTION = 0.03, 0.005
# Minimum ratio of the density of changed pixels on a moving person to the density elsewhere.
MOTION_DENSITY_RATIO = 8.0
# Minimum standard deviation of the model's pixels at which motion is visible, grey levels.
MIN_MODEL_CONTRAST = 4.0
# Difference of a channel above which a pixel has changed, grey levels; larger than the noise of
# means over 3 x 3 pixels of the raster.
CHANGED_LEVELS = 24


class Motion(NamedTuple):
    """Changes since the last learned image.

    Attributes:
        moved: whether pixels of the model have changed, while the rest of the image has not.
        still: whether nothing has changed, so that the person has not moved.
    """

    moved: bool
    still: bool


class Colours:
    """The colours of one person, compared with the colours of the surroundings.

    Attributes:
        size: (width, height) of the model, px of the raster.
        here, elsewhere: usual mean of p(M | colour) over a box at the person, and usual maximum of
            such means over boxes that do not touch the person; NaN if unknown.
    """

    def __init__(self) -> None:
        self.size = (0, 0)
        self.here = self.elsewhere = math.nan
        self._inside: Array | None = None
        self._around = self._scene = np.zeros(BINS**3)
        # Last learned image, the pixels of the model in it, and pixels well beyond the model.
        self._image: Image | None = None
        self._model = self._beyond = np.empty((0, 0), np.bool_)

    def score(self, image: Image, *, unseen: float = 0.0) -> float | None:
        """Score of the person's colours in an image (h, w, 3) BGR; None if undecided.

        Args:
            image: image on the raster.
            unseen: value of p(M | colour) for colours that are in no learned image.
        """
        contrast = self.here - self.elsewhere
        if self._inside is None or not contrast >= MIN_CONTRAST:
            return None
        bins = binned(image)
        if np.minimum(shares(bins), self._scene).sum() < 0.5:  # most of the image has new colours
            return None
        return float((self._means(bins, unseen).max() - self.elsewhere) / contrast)

    def stillness(self, image: Image) -> float:
        """Similarity, from 0 to 1, of an image (h, w, 3) to the last learned scene."""
        if self._image is None:
            return 0.0
        changed, outside = self._changed(image), counted(self._beyond)
        least = min(self._beyond.size - outside, outside)
        share = counted(changed & self._beyond) / max(least, 1)
        return max(1.0 - share / MAX_CHANGE, 0.0)

    def motion(self, image: Image) -> Motion:
        """Changes from the last learned image to an image (h, w, 3)."""
        model, other = counted(self._model), counted(self._beyond)
        if self._image is None or not model or image[self._model].std() < MIN_MODEL_CONTRAST:
            return Motion(moved=False, still=False)
        changed = self._changed(image)
        here, there = (counted(changed & part) for part in (self._model, self._beyond))
        moved = (
            here > MOVED_FRACTION * model and here * other > MOTION_DENSITY_RATIO * there * model
        )
        return Motion(moved, counted(changed) < UNMOVED_FRACTION * model)

    def _changed(self, image: Image) -> Mask:
        """Pixels (h, w) that differ from the last learned image."""
        assert self._image is not None
        change = cv2.absdiff(cv2.blur(image, (3, 3)), self._image)
        return np.asarray(cv2.inRange(change, (0, 0, 0), (CHANGED_LEVELS,) * 3) == 0)

    def learn(self, image: Image, model: Mask, dt: float) -> None:
        """Learns from an image (h, w, 3) with the person on the pixels (h, w) of the model.

        Args:
            image, model: image and mask on the raster.
            dt: time since the last learned image, s.
        """
        outside = beyond(model)
        around = surroundings(model, outside)
        if not model.any() or not around.any():
            return
        bins = binned(image)
        # One pass counts the pixels on the model, around the model, and elsewhere.
        counts = np.empty((3, BINS**3), np.int64)
        count_colours(bins, model + 2 * around.view(np.uint8), counts)
        on, off = (x / max(x.sum(), 1) for x in counts[1:])
        scene = counts.sum(0) / bins.size
        first = self._inside is None
        gain = 1.0 if first else -float(elementary.expm1(-dt / MEMORY_TIME))
        self._inside = on if self._inside is None else self._inside + gain * (on - self._inside)
        self._around = self._around + gain * (off - self._around)
        self._scene = self._scene + gain * (scene - self._scene)
        x, y, width, height = cv2.boundingRect(model.view(np.uint8))
        self.size = width, height
        self._image, self._model = np.asarray(cv2.blur(image, (3, 3)), np.uint8), model
        self._beyond = outside
        means = self._means(bins)
        row, column = y + height // 2, x + width // 2
        here = float(means[row, column])
        # Exclude boxes that overlap with the person's box.
        means[max(row - height, 0) : row + height, max(column - width, 0) : column + width] = -1.0
        elsewhere = float(means.max())
        self.here = _moved(self.here, here, gain)
        if elsewhere >= 0.0:
            self.elsewhere = _moved(self.elsewhere, elsewhere, gain)

    def _means(self, bins: NDArray[np.uint16], unseen: float = 0.0) -> NDArray[np.float32]:
        """Mean of p(M | colour) over a box at each pixel (h, w); 0 is used outside the image."""
        assert self._inside is not None
        # The added share of one pixel keeps the ratio of very rare colours near 0.
        whole = self._inside + self._around + 1.0 / bins.size
        ratio = (self._inside / whole).astype(np.float32)
        if unseen:
            ratio[self._scene < 1.0 / bins.size] = unseen
        size = (max(self.size[0], 1), max(self.size[1], 1))
        means = cv2.boxFilter(ratio.take(bins), cv2.CV_32F, size, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(means, dtype=np.float32)


def _moved(usual: float, value: float, gain: float) -> float:
    return value if math.isnan(usual) else usual + gain * (value - usual)


def binned(image: Image) -> NDArray[np.uint16]:
    """Colour bins (h, w) of the pixels of an image (h, w, 3)."""
    result = np.empty(image.shape[:2], np.uint16)
    bin_colours(np.ascontiguousarray(image), BINS, result)
    return result


def shares(bins: NDArray[np.uint16]) -> Array:
    """Share (BINS^3,) of the pixels in each colour bin."""
    counts = np.empty((1, BINS**3), np.int64)
    count_colours(bins, np.zeros(bins.shape, np.uint8), counts)
    return np.asarray(counts[0] / bins.size)


def surroundings(model: Mask, outside: Mask) -> Mask:
    """Pixels (H, W) around the model, up to a distance of half the model's size.

    Args:
        model, outside: pixels of the model, and the result of `beyond` for this model.
    """
    x, y, width, height = cv2.boundingRect(model.view(np.uint8))
    margin = max(width, height) // 2
    rows = slice(max(y - margin, 0), y + height + margin)
    columns = slice(max(x - margin, 0), x + width + margin)
    result = np.zeros(model.shape, dtype=np.bool_)
    result[rows, columns] = outside[rows, columns]
    return result


def beyond(model: Mask) -> Mask:
    """Pixels (H, W) farther from the model than a tenth of the model's size."""
    *_, width, height = cv2.boundingRect(model.view(np.uint8))
    near = max(max(width, height) // 10, 1)
    size = (2 * near + 1, 2 * near + 1)
    return np.asarray(cv2.dilate(model.view(np.uint8), np.ones(size, np.uint8)) == 0)
