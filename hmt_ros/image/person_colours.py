"""The colours of a person, whether an image shows them, and whether the person has moved.

    p(M | colour) = h_M / (h_M + h_around)              ratio of two histograms
    B(x) = mean of p(M | colour) over a box at x        as large as the model
    score = (max B - elsewhere) / (here - elsewhere)

M are the pixels that the model covers. `here` and `elsewhere` are the usual value of B where the
person is, and its usual maximum over boxes beside the person: the score is about 1 where the image
shows somebody in these colours anywhere, and about 0 in a room without the person. Colours are no
evidence if the two are alike, or if the image has other colours than the images before it, as with
a covered lens or another light.

Their absence is evidence against the person only in the scene that they were learned in:

    stillness = 1 - changed pixels beyond the model / (LARGEST_CHANGE pixels of the model), >= 0

After a change `elsewhere` belongs to another scene: the camera has moved, and the lost colours may
be those of an object that the model covered. A person who moves beyond the model changes as many
pixels. A colour that no earlier image had may belong to the person, who has turned around.
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

# Time constant of the usual values of a person, s.
MEMORY_TIME = 2.0
# Time from one learning of the colours to the next, s: they hardly change.
LEARNING_INTERVAL = 0.1
# Changed pixels beyond the model above which the scene is another one, as a fraction of the pixels
# not beyond it, or of those beyond it if they are fewer. A shadow moves with the person.
LARGEST_CHANGE = 0.25
# Minimum difference between `here` and `elsewhere` that is evidence, a probability.
MIN_CONTRAST = 0.15
# Bins of a colour channel, whose values are 0 to 255.
BINS = 8
# Minimum fraction of a model's pixels that change if the person moves, and maximum if nothing does.
MOVED_FRACTION, UNMOVED_FRACTION = 0.03, 0.005
# Minimum ratio of the density of changes on a moving person to that elsewhere.
MOTION_DENSITY_RATIO = 8.0
# Minimum standard deviation of the pixels of a model whose motion can be seen, grey levels.
MIN_MODEL_CONTRAST = 4.0
# Difference in a channel above which a pixel has changed, grey levels; noise in means of 3 x 3
# pixels of the raster is smaller.
CHANGED_LEVELS = 24


class Motion(NamedTuple):
    """Changes since the image that was learned last.

    Attributes:
        moved: whether the pixels of the model have changed, and the rest of the image has not.
        still: whether nothing has changed, so that the person is still there.
    """

    moved: bool
    still: bool


class Colours:
    """The colours of one person against those of the surroundings.

    Attributes:
        size: (width, height) of the model, px of the raster.
        here, elsewhere: usual means of p(M | colour) over a box at the person and over one beside;
            NaN if unknown.
    """

    def __init__(self) -> None:
        self.size = (0, 0)
        self.here = self.elsewhere = math.nan
        self._inside: Array | None = None
        self._around = self._scene = np.zeros(BINS**3)
        # The last image that was learned, the pixels of the model in it, and those well beyond it.
        self._image: Image | None = None
        self._model = self._beyond = np.empty((0, 0), np.bool_)

    def score(self, image: Image, *, unseen: float = 0.0) -> float | None:
        """Score of the person's colours in an image (h, w, 3) BGR; None if undecided.

        Args:
            image: on the raster.
            unseen: p(M | colour) of a colour that no image has had.
        """
        contrast = self.here - self.elsewhere
        if self._inside is None or not contrast >= MIN_CONTRAST:
            return None
        bins = binned(image)
        if np.minimum(shares(bins), self._scene).sum() < 0.5:  # most of it has other colours
            return None
        return float((self._means(bins, unseen).max() - self.elsewhere) / contrast)

    def stillness(self, image: Image) -> float:
        """Likeness, from 0 to 1, of an image (h, w, 3) to the scene that was learned last."""
        if self._image is None:
            return 0.0
        changed, outside = self._changed(image), counted(self._beyond)
        least = min(self._beyond.size - outside, outside)
        share = counted(changed & self._beyond) / max(least, 1)
        return max(1.0 - share / LARGEST_CHANGE, 0.0)

    def motion(self, image: Image) -> Motion:
        """Changes from the image that was learned last to an image (h, w, 3)."""
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
        """Pixels (h, w) that differ from the image that was learned last."""
        assert self._image is not None
        change = cv2.absdiff(cv2.blur(image, (3, 3)), self._image)
        return np.asarray(cv2.inRange(change, (0, 0, 0), (CHANGED_LEVELS,) * 3) == 0)

    def learn(self, image: Image, model: Mask, dt: float) -> None:
        """Learns from an image (h, w, 3) with the person on the pixels (h, w) of the model.

        Args:
            image, model: on the raster.
            dt: time since the last image that was learned, s.
        """
        outside = beyond(model)
        around = surroundings(model, outside)
        if not model.any() or not around.any():
            return
        bins = binned(image)
        # One pass counts the pixels on the model, around it, and all others.
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
        # Boxes that do not touch that of the person.
        means[max(row - height, 0) : row + height, max(column - width, 0) : column + width] = -1.0
        elsewhere = float(means.max())
        self.here = _moved(self.here, here, gain)
        if elsewhere >= 0.0:
            self.elsewhere = _moved(self.elsewhere, elsewhere, gain)

    def _means(self, bins: NDArray[np.uint16], unseen: float = 0.0) -> NDArray[np.float32]:
        """Mean of p(M | colour) over a box at each pixel (h, w); beyond the image it is 0."""
        assert self._inside is not None
        # A colour of less than a pixel belongs to neither.
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
    """The bin of the colour of each pixel (h, w) of an image (h, w, 3)."""
    result = np.empty(image.shape[:2], np.uint16)
    bin_colours(np.ascontiguousarray(image), BINS, result)
    return result


def shares(bins: NDArray[np.uint16]) -> Array:
    """Share (BINS^3,) of each colour among pixels."""
    counts = np.empty((1, BINS**3), np.int64)
    count_colours(bins, np.zeros(bins.shape, np.uint8), counts)
    return np.asarray(counts[0] / bins.size)


def surroundings(model: Mask, outside: Mask) -> Mask:
    """Pixels (H, W) around those that the model covers, up to half its size away.

    Args:
        model, outside: pixels of the model, and those beyond it, see `beyond`.
    """
    x, y, width, height = cv2.boundingRect(model.view(np.uint8))
    margin = max(width, height) // 2
    rows = slice(max(y - margin, 0), y + height + margin)
    columns = slice(max(x - margin, 0), x + width + margin)
    result = np.zeros(model.shape, dtype=np.bool_)
    result[rows, columns] = outside[rows, columns]
    return result


def beyond(model: Mask) -> Mask:
    """Pixels (H, W) that are farther from those of the model than a tenth of its size."""
    *_, width, height = cv2.boundingRect(model.view(np.uint8))
    near = max(max(width, height) // 10, 1)
    size = (2 * near + 1, 2 * near + 1)
    return np.asarray(cv2.dilate(model.view(np.uint8), np.ones(size, np.uint8)) == 0)
