"""The person's silhouette by background subtraction, shadows removed.

The background is either a given image of the empty scene or learned from frames in which the person
is absent or moves. A model of the table `BACKGROUNDS` labels the pixels of images reduced to about
`IMAGE_LINES` lines, so that the cost does not depend on the camera's resolution. The outline is
interpolated with subpixel accuracy. If the background shows the person, it is rebuilt from those
pixels of later images that the person does not cover.

`SceneWatch` checks whether the camera has moved since the background was taken:

    r(s) = normalised cross-correlation of |grad background| with |grad image|, shifted by s

on images that are `WIDTH` px wide, for shifts of up to `REACH`. The maximum is at s = 0 as long as
the camera has not moved, even if people walk in front of it or the light changes, because edges
stay in place. After a small movement the maximum is at another shift; after a large movement no
shift fits.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import elementary, gradient_lengths
from hmt_ros.image.pixel_backgrounds import (
    FOREGROUND_LABEL,
    SHADOW_LABEL,
    Background,
    mixture_background,
    neighbour_background,
)
from hmt_ros.inference.arrays import Image, Mask

Box = tuple[int, int, int, int]

# Constructors of background models, by `BackgroundSettings.method`. A new model needs a file of its
# own and a line here.
BACKGROUNDS: dict[str, Callable[[float, float], Background]] = {
    'mog2': mixture_background,
    'knn': neighbour_background,
}

# Approximate number of lines of reduced images; they are reduced by an integer factor.
IMAGE_LINES = 240

# Tolerance when a pixel is compared with neighbouring pixels of the background, because compression
# and aliasing move edges, grey levels.
SPATIAL_TOLERANCE = 8
# Number of images that must agree at a pixel that the person does not cover, before the pixel is
# known again, and tolerance of this agreement, grey levels.
AGREEING_IMAGES = 10
AGREEMENT_TOLERANCE = 20.0
# Margin around a mask for morphological operations, px.
MASK_MARGIN = 2


@dataclass(frozen=True)
class BackgroundSettings:
    """How the background is subtracted.

    Attributes:
        method: Background model of OpenCV, 'mog2' or 'knn'.
        threshold: Squared distance from the background, in its variances, above which a pixel is
            foreground.
        shadow_threshold: Smallest brightness of a shadow, as a fraction of the background's; darker
            pixels are foreground.
        smallest_part: Smallest area of a piece of the silhouette, as a fraction of the largest
            piece's; smaller pieces are dropped.
        largest_gap: Maximum distance of a piece of the silhouette from the largest one, as a
            fraction of its height; pieces further away are dropped.
    """

    method: str = 'mog2'
    threshold: float = 20.0
    shadow_threshold: float = 0.3
    smallest_part: float = 0.004
    largest_gap: float = 0.2

    def __post_init__(self) -> None:
        if self.method not in BACKGROUNDS:
            known = ' or '.join(BACKGROUNDS)
            raise ValueError(f'background method must be {known}, saw {self.method!r}')

    def new_model(self) -> Background:
        """A new background model of the chosen method."""
        return BACKGROUNDS[self.method](self.threshold, self.shadow_threshold)


class Silhouette(NamedTuple):
    """Pixels that differ from the background.

    Attributes:
        foreground: (H, W) pixels of the person.
        unsure: (H, W) darker pixels of the same colour as the background: a shadow, or clothes in
            the colours of the scene; None if missing.
    """

    foreground: Mask
    unsure: Mask | None = None


class BackgroundModel:
    """Learns an empty scene and finds pixels that differ from it.

    Attributes:
        settings: parameters of the subtraction.
        frames: number of learned images.
        changed: fraction of the pixels of the last image that differ from the background, including
            shadows.
    """

    def __init__(self, settings: BackgroundSettings | None = None) -> None:
        self.settings = settings or BackgroundSettings()
        self._model = self.settings.new_model()
        self.frames = 0
        self.changed = 0.0
        self._shape: tuple[int, ...] = ()
        self._nearby: tuple[Image, Image] | None = None
        # The last image and its labels are cached, because several people share one background.
        self._last: tuple[Image, Image] | None = None
        self._parts: _Parts | None = None

    @classmethod
    def from_image(
        cls, background: Image, settings: BackgroundSettings | None = None
    ) -> BackgroundModel:
        """A model learned from one image of the empty scene, (H, W, 3) uint8."""
        model = cls(settings)
        model._learn_alone(background)
        return model

    def learn(self, image: Image) -> None:
        """Adds a frame (H, W, 3) of the scene to the model.

        Raises:
            ValueError: the image differs in shape from earlier images.
        """
        if self.frames == 0:
            self._shape = image.shape
        self._check(image)
        self.frames += 1
        self._model.learn(self._smaller(image), 1.0 / self.frames)
        self._nearby = self._last = None

    def forget(self) -> None:
        """Forgets the background, which `complete` then rebuilds."""
        shape = self._shape
        if self.frames == 0:
            return
        self._parts = _Parts(shape)
        self._learn_alone(np.zeros(shape, dtype=np.uint8))

    def complete(self, image: Image, person: Mask) -> None:
        """Learns those unknown pixels of the background that the person (H, W) does not cover.

        Raises:
            ValueError: the image differs in shape from earlier images.
        """
        self._check(image)
        if self._parts is None:
            return
        self._parts.add(image, ~person)
        if not self._parts.unknown.any():
            self._learn_alone(self._parts.image)
            self._parts = None

    @property
    def unknown(self) -> Mask | None:
        """Pixels (H, W) whose background is unknown since `forget`; None if all are known."""
        return None if self._parts is None else self._parts.unknown

    @property
    def empty(self) -> Image:
        """Known parts of the empty scene (h, w, 3), at the size of the reduced images."""
        return self._model.empty

    def foreground(self, image: Image) -> Mask:
        """Pixels (H, W) that differ from the background and are not shadow.

        False where the background is unknown. The model does not change.

        Raises:
            ValueError: no background was learned, or the image has a wrong size.
        """
        return self._larger(self._subtracted(image) == FOREGROUND_LABEL)

    def silhouette(self, image: Image, region: Box | None = None) -> Mask:
        """Silhouette (H, W): the largest piece of the foreground, and pieces near it; no shadow.

        Empty if nothing differs from the background. The model does not change.

        Args:
            image: (H, W, 3) uint8.
            region: box (left, top, right, bottom) that can contain the person, px; right and bottom
                are exclusive.

        Raises:
            ValueError: no background was learned, or the image has a wrong size.
        """
        return self.split(image, region).foreground

    def split(
        self, image: Image, region: Box | None = None, others: Mask | None = None
    ) -> Silhouette:
        """The result of `silhouette` for an image, and the unsure pixels.

        Args:
            others: (H, W) pixels that other people cover; None if missing.
        """
        raw = self._subtracted(image)
        if others is not None:
            raw = np.where(self._any_of(others), 0, raw).astype(np.uint8)
        inside = _around(raw, self._smaller_box(region))
        part, square = raw[inside], np.ones((3, 3), np.uint8)
        masks = np.zeros((2, *raw.shape), np.bool_)
        if part.size:
            person, unsure = ((part == x).view(np.uint8) for x in (FOREGROUND_LABEL, SHADOW_LABEL))
            if self._factor == 1:
                person = np.asarray(cv2.morphologyEx(person, cv2.MORPH_OPEN, square), np.uint8)
            for mask, pixels in zip(masks, (person, unsure), strict=True):
                mask[inside] = cv2.morphologyEx(pixels, cv2.MORPH_CLOSE, square) > 0
            masks[0][inside] = one_person(masks[0][inside], self.settings)
        found, unsure = map(self._larger, masks)
        return Silhouette(found, unsure > found)

    def _subtracted(self, image: Image) -> Image:
        """Label of each pixel (h, w) of the reduced image; see `pixel_backgrounds`."""
        if self.frames == 0:
            raise ValueError('no background has been learned: give an image or some frames first')
        self._check(image)
        parts = self._parts
        if parts is not None and parts.changed:
            self._learn_alone(parts.image)
            parts.changed = False
        if parts is None and self._last is not None and self._last[0] is image:
            return self._last[1]
        small = self._smaller(image)
        raw = self._model.labels(small)
        raw[(raw & self._beside(small)) == FOREGROUND_LABEL] = 0
        if parts is not None:
            raw[self._any_of(parts.unknown)] = 0
        self.changed = cv2.countNonZero(raw) / raw.size
        if parts is None:
            self._last = (image, raw)
        return raw

    def _beside(self, image: Image) -> Image:
        """255 where a pixel (h, w) has the colour of a neighbouring background pixel, else 0."""
        if self._nearby is None:
            empty = self.empty
            square = np.ones((3, 3), np.uint8)
            darkest, brightest = cv2.erode(empty, square), cv2.dilate(empty, square)
            margin = np.full_like(empty, SPATIAL_TOLERANCE)
            self._nearby = (
                np.asarray(cv2.subtract(darkest, margin), dtype=np.uint8),
                np.asarray(cv2.add(brightest, margin), dtype=np.uint8),
            )
        lowest, highest = self._nearby
        return np.asarray(cv2.inRange(image, lowest, highest), dtype=np.uint8)

    @property
    def _factor(self) -> int:
        """Integer factor by which width and height of images are reduced."""
        return max(round(self._shape[0] / IMAGE_LINES), 1)

    def _smaller(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Reduces an image (H, W) or (H, W, 3) by averaging blocks of pixels."""
        if self._factor == 1:
            return image
        size = tuple(-(-x // self._factor) for x in image.shape[1::-1])
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def _any_of(self, mask: Mask) -> Mask:
        """Pixels (h, w) of the reduced image that a mask (H, W) covers at least in part."""
        return self._smaller(255 * mask.view(np.uint8)) > 0

    def _larger(self, mask: Mask) -> Mask:
        """A mask (h, w) enlarged to the size of images (H, W), its outline interpolated."""
        if self._factor == 1:
            return mask
        factor, result = self._factor, np.zeros(self._shape[:2], np.uint8)
        part, larger = mask, result
        if tuple(factor * x for x in mask.shape) == result.shape:
            rows, columns = inside = _around(mask)
            part = mask[inside]
            larger = result[
                factor * rows.start : factor * rows.stop,
                factor * columns.start : factor * columns.stop,
            ]
        if part.size:
            pixels = cv2.resize(255 * part.view(np.uint8), larger.shape[::-1])
            cv2.threshold(pixels, 127, 1, cv2.THRESH_BINARY, larger)
        return result.view(np.bool_)

    def _smaller_box(self, box: Box | None) -> Box | None:
        """A region in pixels of the reduced image, rounded outwards."""
        if box is None:
            return None
        left, top, right, bottom = box
        factor = self._factor
        return left // factor, top // factor, -(-right // factor), -(-bottom // factor)

    def _learn_alone(self, background: Image) -> None:
        """Replaces the background by one image (H, W, 3) of the empty scene."""
        self._model = self.settings.new_model()
        self.frames = 0
        for _ in range(self._model.repeats):
            self.learn(background)

    def _check(self, image: Image) -> None:
        # OpenCV would silently start a new model if the shape changed.
        if image.shape != self._shape:
            raise ValueError(f'the background has shape {self._shape}, saw an image {image.shape}')


class _Parts:
    """A background that is assembled from parts of images.

    Args:
        shape: (H, W, 3) of the images.

    Attributes:
        unknown: (H, W) pixels whose background is still unknown.
        changed: whether pixels have become known since the flag was last cleared.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._mean = np.zeros(shape, dtype=np.float32)
        self.unknown: Mask = np.ones(shape[:2], dtype=np.bool_)
        self.changed = False
        self._agreeing = np.zeros(shape[:2], dtype=np.int32)

    @property
    def image(self) -> Image:
        """The background (H, W, 3), which can have unknown pixels."""
        return np.asarray(np.rint(self._mean), dtype=np.uint8)

    def add(self, image: Image, empty: Mask) -> None:
        """Learns unknown pixels from an image, at pixels (H, W) where the scene is empty."""
        rows, columns = np.nonzero(empty & self.unknown)
        values = image[rows, columns].astype(np.float32)
        mean, agreeing = self._mean[rows, columns], self._agreeing[rows, columns]
        # Where an image disagrees, counting restarts: a person was there before or is there now.
        agreeing[np.abs(values - mean).max(1, initial=0.0) > AGREEMENT_TOLERANCE] = 0
        agreeing += 1
        self._mean[rows, columns] = mean + (values - mean) / agreeing[:, None]
        self._agreeing[rows, columns] = agreeing
        done = agreeing >= AGREEING_IMAGES
        self.unknown[rows[done], columns[done]] = False
        self.changed |= bool(done.any())


def one_person(mask: Mask, settings: BackgroundSettings, region: Box | None = None) -> Mask:
    """The largest piece of a mask (H, W), and pieces large and near enough to belong to it."""
    result = np.zeros(mask.shape, dtype=np.bool_)
    inside = _around(mask, region)
    part = mask[inside]
    if part.size:
        labels, stats = pieces_of(part)
        result[inside] = of_one_person(stats, settings).take(labels)
    return result


def pieces_of(mask: Mask) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Labels (H, W) and OpenCV's statistics (N, 5) of the connected pieces of a mask."""
    pixels = np.ascontiguousarray(mask).view(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        pixels, 8, cv2.CV_32S, cv2.CCL_BBDT
    )
    return np.asarray(labels, np.int32), np.asarray(stats, np.int32)


def of_one_person(stats: NDArray[np.int32], settings: BackgroundSettings) -> Mask:
    """Whether each piece (N,) of a mask belongs to the largest piece; piece 0 is the background.

    Args:
        stats: (N, 5) OpenCV's statistics of the pieces.
        settings: minimum size of a piece, and maximum distance from the largest piece.
    """
    area = stats[:, cv2.CC_STAT_AREA]
    main = 1 + int(np.argmax(area[1:]))
    near_corners = stats[:, :2]
    far_corners = near_corners + stats[:, 2:4]
    gap = settings.largest_gap * stats[main, cv2.CC_STAT_HEIGHT]
    apart = np.maximum(near_corners - far_corners[main], near_corners[main] - far_corners).max(1)
    keep = (apart < gap) & (area >= settings.smallest_part * area[main])
    keep[main], keep[0] = True, False
    return np.asarray(keep)


def _around(pixels: NDArray[np.bool_ | np.uint8], region: Box | None = None) -> tuple[slice, slice]:
    """Slices of rows and columns around the nonzero pixels in a region (None: all), with a margin.

    The slices are empty if all pixels are 0. They save time, because most of an image is empty.
    """
    left, top, right, bottom = region or (0, 0, pixels.shape[1], pixels.shape[0])
    part = pixels[top:bottom, left:right].view(np.uint8)
    x, y, width, height = cv2.boundingRect(part) if part.size else (0, 0, 0, 0)
    if width == 0:
        return slice(0, 0), slice(0, 0)
    return (
        slice(top + max(y - MASK_MARGIN, 0), min(top + y + height + MASK_MARGIN, bottom)),
        slice(left + max(x - MASK_MARGIN, 0), min(left + x + width + MASK_MARGIN, right)),
    )


WIDTH, REACH = 320, 24
# Maximum gradient length; standard deviation of the Gaussian before the derivative, px.
MAX_GRADIENT, SMOOTHING_SIGMA = 200.0, 1.0
# Only every n-th image is examined: n, and number of successive examined images that must agree.
EXAMINATION_INTERVAL, CONFIRMING_IMAGES = 10, 2
# Minimum correlation at the best shift, and its minimum excess over the correlation at shift 0.
MIN_CORRELATION, MIN_CORRELATION_GAIN = 0.3, 0.05
# Correlation at shift 0 below which the scene has changed, as a fraction of its first value.
OTHER_SCENE_FRACTION = 0.4


class SceneWatch:
    """Detects movement of a camera that should stand still.

    Attributes:
        moved: whether the camera has moved since the background was taken.
        shift: displacement of the scene since the background was taken, px; NaN if too large to
            measure.
    """

    def __init__(self) -> None:
        self.moved = False
        self.shift = 0.0
        self._count = self._signs = 0
        self._seen: tuple[BackgroundModel | None, int] = None, 0
        self._edges: NDArray[np.float32] | None = None
        self._usual = 0.0

    def update(self, image: Image, background: BackgroundModel) -> None:
        """Compares an image (H, W, 3) with a background; skipped if the background has gaps."""
        self._count += 1
        if self._count % EXAMINATION_INTERVAL != 1 or background.unknown is not None:
            return
        if self._seen != (background, background.frames):
            self._seen = background, background.frames
            self._edges, self._usual, self._signs = edges_of(background.empty), 0.0, 0
        assert self._edges is not None
        shift, best, here = _correlation(self._edges, edges_of(image))
        self._usual = self._usual or here
        elsewhere = best >= MIN_CORRELATION and best - here >= MIN_CORRELATION_GAIN
        another = self._usual >= MIN_CORRELATION and here < OTHER_SCENE_FRACTION * self._usual
        self._signs = self._signs + 1 if elsewhere or another else 0
        self.moved = self._signs >= CONFIRMING_IMAGES
        self.shift = shift * image.shape[1] / WIDTH if elsewhere else np.nan if another else 0.0


def edges_of(image: Image) -> NDArray[np.float32]:
    """Gradient magnitudes (h, w) of an image (H, W, 3) that is reduced to `WIDTH`."""
    height = max(round(image.shape[0] * WIDTH / image.shape[1]), 2 * REACH + 8)
    small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), SMOOTHING_SIGMA)
    slopes = cv2.Sobel(small, cv2.CV_16S, 1, 0), cv2.Sobel(small, cv2.CV_16S, 0, 1)
    result = np.empty(small.shape[:2], np.float32)
    gradient_lengths(*slopes, MAX_GRADIENT, result)
    return result


def _correlation(
    background: NDArray[np.float32], image: NDArray[np.float32]
) -> tuple[float, float, float]:
    """Length of the best shift, px, correlation at this shift, and correlation at shift 0."""
    inner = background[REACH:-REACH, REACH:-REACH]
    found = np.nan_to_num(cv2.matchTemplate(image, inner, cv2.TM_CCOEFF_NORMED))
    row, column = np.unravel_index(int(found.argmax()), found.shape)
    shift = float(elementary.hypot(row - REACH, column - REACH))
    return shift, float(found[row, column]), float(found[REACH, REACH])
