"""Usual appearance of one person, in silhouettes and colours, and whether an image shows it.

    place    share of the model that is foreground / usual share
    area     area of the largest piece of the foreground that has the shape of one person / usual

Where the clothes have the colours of the room only a part of the model is foreground: the share is
compared with that of earlier images of the track. A person who has not been seen for a time t may
have gone SPEED t further away; the usual area shrinks accordingly.

The colours of a person, and whether an image shows them anywhere.

    p(M | colour) = h_M / (h_M + h_around)              ratio of two histograms
    B(x) = mean of p(M | colour) over a box at x        as large as the model
    score = (max B - elsewhere) / (here - elsewhere)

M are the pixels that the model covers. `here` and `elsewhere` are the usual value of B where the
person is, and its usual maximum over boxes beside the person: the score is about 1 where the image
shows somebody in these colours, wherever that is, and about 0 in a room without the person. Colours
are no evidence where the two are alike, or where the image has other colours than the images before
it: a covered lens, another light.

Their absence is evidence against the person only in the scene that they were learned in:

    stillness = 1 - changed pixels beyond the model / (UNDECIDED pixels of the model), at least 0

Otherwise `elsewhere` belongs to another scene: the camera has moved, and the lost colours may be
those of a thing that the model covered. A person who moves beyond the model changes as many pixels.
A colour that no image had may belong to the person, who turns about.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.inference.error_model import seconds
from hmt_ros.tracking.person_shape import (
    Piece,
    counted,
    covered,
    largest_person,
    on_raster,
    raster_step,
)
from hmt_ros.tracking.silhouettes import SPEED
from hmt_ros.tracking.view import View

# Fraction of the usual value at which a silhouette is no evidence; at 0 it says that somebody is
# absent, at twice this fraction present.
# It also limits the changed pixels beyond the model, relative to those of the person, or to those
# beyond if they are fewer: a shadow goes with the person. More changes show another scene.
UNDECIDED = 0.25
# Colours are learned once in so many seconds: they hardly change.
LEARNED = 0.1
# More than this fraction of an image, or of a person, is most of it.
MOST = 0.5
# Time constant of the usual values of a track, s.
MEMORY = 2.0
# Least difference between `here` and `elsewhere` that is evidence, a probability.
LEAST_CONTRAST = 0.15
# Bins of a colour channel.
BINS = 8
# Shares of the pixels of a model that change where it moves, and at most where nothing does; how
# many times denser changes are there than elsewhere. Least contrast of a model, grey levels.
MOVED, UNMOVED, APART, CONTRAST = 0.03, 0.005, 4.0, 4.0
# A pixel that differs by more than this in a channel shows something else, grey levels; the means
# of 3 x 3 pixels of the raster do not differ by that much from noise.
OTHER = 24


class Motion(NamedTuple):
    """What has moved since the image that was learned last.

    Attributes:
        moved: whether the person has, where the model was, and the rest of the image has not.
        still: whether nothing has: whoever was there still is.
    """

    moved: bool
    still: bool


class Colours:
    """The colours of one person against those of the surroundings.

    Attributes:
        size: (width, height) of the model, px of the raster.
        here, elsewhere: usual means of p(M | colour) over a box at the person and beside; NaN:
            unknown.
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
        """Score of the person's colours in an image (h, w, 3) BGR; None: undecided.

        Args:
            image: on the raster.
            unseen: p(M | colour) of a colour that no image has had.
        """
        contrast = self.here - self.elsewhere
        if self._inside is None or not contrast >= LEAST_CONTRAST:
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
        return max(1.0 - share / UNDECIDED, 0.0)

    def motion(self, image: Image) -> Motion:
        """What has moved since the image that was learned last."""
        model, other = counted(self._model), counted(self._beyond)
        if self._image is None or not model or image[self._model].std() < CONTRAST:
            return Motion(moved=False, still=False)
        changed = self._changed(image)
        here, there = (counted(changed & part) for part in (self._model, self._beyond))
        moved = here > MOVED * model and here * other > APART * there * model
        return Motion(moved, counted(changed) < UNMOVED * model)

    def _changed(self, image: Image) -> Mask:
        """Pixels (h, w) that differ from the image that was learned last."""
        assert self._image is not None
        return np.asarray(cv2.absdiff(cv2.blur(image, (3, 3)), self._image).max(axis=2) > OTHER)

    def learn(self, image: Image, model: Mask, dt: float) -> None:
        """Takes in an image (h, w, 3) with the person on the pixels (h, w) of the model.

        Args:
            image, model: on the raster.
            dt: time since the last image that was learned, s.
        """
        around = surroundings(model)
        if not model.any() or not around.any():
            return
        bins = binned(image)
        # One pass counts the pixels on the model, around it, and all others.
        counts = np.bincount(
            (bins + BINS**3 * (model + 2 * around.view(np.uint8)).astype(np.uint16)).ravel(),
            minlength=3 * BINS**3,
        ).reshape(3, -1)
        on, off = (x / max(x.sum(), 1) for x in counts[1:])
        scene = counts.sum(0) / bins.size
        first = self._inside is None
        gain = 1.0 if first else -math.expm1(-dt / MEMORY)
        self._inside = on if self._inside is None else self._inside + gain * (on - self._inside)
        self._around = self._around + gain * (off - self._around)
        self._scene = self._scene + gain * (scene - self._scene)
        x, y, width, height = cv2.boundingRect(model.view(np.uint8))
        self.size = width, height
        self._image, self._model = np.asarray(cv2.blur(image, (3, 3)), np.uint8), model
        self._beyond = beyond(model)
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
        # A colour of less than a pixel is nobody's.
        whole = self._inside + self._around + 1.0 / bins.size
        ratio = (self._inside / whole).astype(np.float32)
        if unseen:
            ratio[self._scene < 1.0 / bins.size] = unseen
        size = (max(self.size[0], 1), max(self.size[1], 1))
        means = cv2.boxFilter(ratio[bins], cv2.CV_32F, size, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(means, dtype=np.float32)


def _moved(usual: float, value: float, gain: float) -> float:
    return value if math.isnan(usual) else usual + gain * (value - usual)


def binned(image: Image) -> NDArray[np.uint16]:
    """The bin of the colour of each pixel (h, w) of an image (h, w, 3)."""
    width = 256 // BINS
    parts = (image // np.uint8(width)).astype(np.uint16)
    result: NDArray[np.uint16] = (parts[..., 0] * BINS + parts[..., 1]) * BINS + parts[..., 2]
    return result


def shares(bins: NDArray[np.uint16]) -> Array:
    """Share (BINS^3,) of each colour among pixels."""
    return np.bincount(bins.ravel(), minlength=BINS**3) / bins.size


def surroundings(model: Mask) -> Mask:
    """Pixels (H, W) around those that the model covers, up to half its size away."""
    x, y, width, height = cv2.boundingRect(model.view(np.uint8))
    margin = max(width, height) // 2
    rows = slice(max(y - margin, 0), y + height + margin)
    columns = slice(max(x - margin, 0), x + width + margin)
    result = np.zeros(model.shape, dtype=np.bool_)
    result[rows, columns] = beyond(model)[rows, columns]
    return result


def beyond(model: Mask) -> Mask:
    """Pixels (H, W) that are farther from those of the model than a tenth of its size."""
    *_, width, height = cv2.boundingRect(model.view(np.uint8))
    near = max(max(width, height) // 10, 1)
    size = (2 * near + 1, 2 * near + 1)
    return np.asarray(cv2.dilate(model.view(np.uint8), np.ones(size, np.uint8)) == 0)


class Silhouetted(NamedTuple):
    """Evidence of a silhouette for the presence of a person, from -1, nobody, to 1.

    Attributes:
        by_place: from the share of the model that is foreground.
        by_area: from the largest piece that has the shape of a person, anywhere.
        cut: whether a side of the image may cut that piece.
    """

    by_place: float
    by_area: float
    cut: bool

    @property
    def evidence(self) -> float:
        """The larger of both: a person in a wrong pose is not absent."""
        return max(self.by_place, self.by_area)


class Appearance:
    """How one person usually looks.

    Attributes:
        colours: of the person.
    """

    def __init__(self) -> None:
        self.colours = Colours()
        self._model: Mask | None = None
        self._depth = self._magnification = math.nan
        self._share, self._area = MOST, math.nan
        self._stamp = 0
        self._coloured: int | None = None
        # Foreground of the last image on the raster, and the piece of it that is a person.
        self._foreground: Mask | None = None
        self._piece: Piece | None = None

    def open_to_view(self, others: Mask | None) -> float:
        """Share of the person, where the person was last seen, that others (H, W) do not cover."""
        if self._model is None or others is None:
            return 1.0
        hidden = counted(self._model & on_raster(others, self._model))
        return 1.0 - hidden / max(counted(self._model), 1)

    def unseen(self, stamp: int) -> float:
        """Time for which the person has not been seen at a stamp, ns, in s; never seen: 0."""
        return 0.0 if self._model is None else seconds(stamp - self._stamp)

    def silhouetted(self, view: View, stamp: int) -> Silhouetted | None:
        """Evidence of an image's silhouette; None: it has none, or most of it has changed.

        Args:
            view: of the image.
            stamp: of the image, ns.
        """
        self._foreground, self._piece = None, None
        if view.anywhere is None:
            return None
        model = np.zeros_like(view.anywhere) if self._model is None else self._model
        if view.changed > MOST + counted(model) / model.size:
            return None
        foreground, others = view.anywhere, view.others
        if others is not None and view.silhouette is not None:
            # Others may be in view: only foreground near the person counts.
            foreground = on_raster(view.silhouette, foreground)
            model = model & ~on_raster(others, model)
        self._foreground = foreground
        self._piece = piece = largest_person(foreground, raster_step(len(view.image)))
        place = counted(foreground & model) / max(counted(model), 1)
        area = 0.0
        if piece is not None:
            shrunk = (self._depth / (self._depth + SPEED * self.unseen(stamp))) ** 2
            least = self._area * shrunk * self.open_to_view(others)
            area = 1.0 if math.isnan(least) else piece.area / least
        return Silhouetted(
            _evidence(place / self._share), _evidence(area), piece is not None and piece.cut
        )

    def colour_evidence(self, view: View) -> tuple[bool, float] | None:
        """Whether colours are evidence for somebody, and its weight from 0 to 1; None: neither.

        Evidence against somebody has weight 0 in another scene than that of the last learning.
        """
        image = _coarse(view)
        score = self.colours.score(image)
        if score is None:
            return None
        if score > 0.5:
            return True, min(2.0 * score - 1.0, 1.0)
        most = self.colours.score(image, unseen=1.0)
        if most is None:
            return None
        against = float(np.clip(1.0 - 2.0 * most, 0.0, 1.0))
        return False, against * self.colours.stillness(image)

    def motion(self, view: View) -> Motion:
        """What has moved since the image that was learned last; see `Colours.motion`."""
        return self.colours.motion(_coarse(view))

    def is_apart(self, view: View, stamp: int) -> bool:
        """Whether most keypoints lie beside the box around the model, where a person may have gone.

        Keypoints too far away for so short a time are an error of the detector, or another person.
        """
        keypoints = view.keypoints
        if keypoints is None or self._model is None or not keypoints.seen.any():
            return False
        x, y, width, height = cv2.boundingRect(self._model.view(np.uint8))
        pixels = keypoints.pixels[keypoints.seen] / raster_step(len(view.image))
        low, high = np.array([x, y]), np.array([x + width, y + height])
        away = np.maximum(low - pixels, pixels - high).max(axis=1)
        way = SPEED * self.unseen(stamp) * self._magnification
        return bool(0.25 * max(width, height) < np.median(away) < way)

    def learn(self, view: View, stamp: int, body: Body, camera: Camera, pose: Array) -> None:
        """Learns from an image in which the person is at a pose (d,); `silhouetted` came before."""
        dt = 0.0 if self._model is None else seconds(stamp - self._stamp)
        gain = -math.expm1(-dt / MEMORY)
        self._model = model = covered(body, camera, pose, raster_step(camera.height))
        self._depth, self._stamp = max(float(pose[2]), 0.1), stamp
        self._magnification = camera.magnification(self._depth) / raster_step(camera.height)
        free = self.open_to_view(view.others)
        if free < MOST:
            return
        if view.others is not None:
            model = model & ~on_raster(view.others, model)
        if self._foreground is not None and model.any():
            share = counted(self._foreground & model) / counted(model)
            if share > UNDECIDED * self._share:
                self._share += gain * (share - self._share)
        if self._piece is not None:
            area = self._piece.area / free
            known = not math.isnan(self._area)
            self._area = self._area + gain * (area - self._area) if known else area
        since = math.inf if self._coloured is None else seconds(stamp - self._coloured)
        if since >= LEARNED:
            self.colours.learn(_coarse(view), model, since)
            self._coloured = stamp


def _coarse(view: View) -> Image:
    """The image on the raster."""
    step = raster_step(len(view.image))
    height, width = (-(-x // step) for x in view.image.shape[:2])
    return on_raster(view.image, np.empty((height, width), np.bool_))


def _evidence(value: float) -> float:
    """Evidence, from -1 to 1, of a value relative to the usual one."""
    return min(max(value / UNDECIDED - 1.0, -1.0), 1.0)
