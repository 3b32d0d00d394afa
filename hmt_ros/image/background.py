"""The person's silhouette by background subtraction, shadows removed.

The background is either a given image of the empty scene or learned from frames in which the person
is absent or moves. OpenCV's mixture (MOG2) or nearest-neighbour (KNN) model does the per-pixel
work.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from hmt_ros.inference.arrays import Image, Mask

Box = tuple[int, int, int, int]

# Learning rate at which nothing is learned; at 0 the KNN model would replace its samples at once.
FROZEN = 1e-7


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
        if self.method not in ('mog2', 'knn'):
            raise ValueError(f'background method must be mog2 or knn, saw {self.method!r}')


class BackgroundModel:
    """Learns an empty scene and finds what does not belong to it.

    Attributes:
        frames: number of frames that were learned.
        changed: share of the pixels of the last image that differ from the background, shadows
            among them.
    """

    def __init__(self, settings: BackgroundSettings | None = None) -> None:
        self.settings = settings or BackgroundSettings()
        s = self.settings
        self._model: cv2.BackgroundSubtractorMOG2 | cv2.BackgroundSubtractorKNN
        if s.method == 'mog2':
            self._model = cv2.createBackgroundSubtractorMOG2(varThreshold=s.threshold)
        else:
            self._model = cv2.createBackgroundSubtractorKNN(dist2Threshold=20.0 * s.threshold)
        self._model.setDetectShadows(True)
        self._model.setShadowThreshold(s.shadow_threshold)
        self.frames = 0
        self.changed = 0.0
        self._shape: tuple[int, ...] = ()

    @classmethod
    def from_image(
        cls, background: Image, settings: BackgroundSettings | None = None
    ) -> BackgroundModel:
        """A model of one image of the empty scene, (H, W, 3) uint8."""
        model = cls(settings)
        for _ in range(1 if model.settings.method == 'mog2' else 20):
            model.learn(background)
        return model

    def learn(self, image: Image) -> None:
        """Takes one more frame (H, W, 3) of the scene into the model.

        Raises:
            ValueError: the image is not like those before.
        """
        if self.frames == 0:
            self._shape = image.shape
        self._check(image)
        self.frames += 1
        self._model.apply(image, learningRate=1.0 / self.frames)

    def silhouette(self, image: Image, region: Box | None = None) -> Mask:
        """Foreground (H, W) of an image: the largest piece and what is near it, without shadow.

        Empty where nothing differs from the background. The model does not change.

        Args:
            image: (H, W, 3) uint8.
            region: x and y of the first and of the last pixel but one, where the person can be;
                others may walk elsewhere.

        Raises:
            ValueError: no background was learned, or the image has another size.
        """
        if self.frames == 0:
            raise ValueError('no background has been learned: give an image or some frames first')
        self._check(image)
        raw = self._model.apply(image, learningRate=FROZEN)
        self.changed = cv2.countNonZero(raw) / raw.size
        mask = (raw == 255).astype(np.uint8)
        result = np.zeros(mask.shape, dtype=np.bool_)
        left, top, right, bottom = region or (0, 0, mask.shape[1], mask.shape[0])
        part = np.ascontiguousarray(mask[top:bottom, left:right])
        if part.size:
            opened = cv2.morphologyEx(part, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
            closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
            result[top:bottom, left:right] = _pieces_of_one_person(
                np.asarray(closed, dtype=np.uint8), self.settings
            )
        return result

    def _check(self, image: Image) -> None:
        # OpenCV would silently begin a new model.
        if image.shape != self._shape:
            raise ValueError(f'the background has shape {self._shape}, saw an image {image.shape}')


def _pieces_of_one_person(mask: Image, settings: BackgroundSettings) -> Mask:
    """The largest piece of a mask and the pieces that are large enough and near enough to it."""
    result = np.zeros(mask.shape, dtype=bool)
    x, y, width, height = cv2.boundingRect(mask)
    if width == 0:
        return result
    # Most of an image is empty.
    inside = slice(y, y + height), slice(x, x + width)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask[inside], connectivity=8)
    area = stats[1:, cv2.CC_STAT_AREA]
    main = 1 + int(np.argmax(area))
    keep = np.zeros(count, dtype=bool)
    keep[main] = True
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    right = left + stats[:, cv2.CC_STAT_WIDTH]
    bottom = top + stats[:, cv2.CC_STAT_HEIGHT]
    gap = settings.largest_gap * stats[main, cv2.CC_STAT_HEIGHT]
    apart_x = np.maximum(left - right[main], left[main] - right)
    apart_y = np.maximum(top - bottom[main], top[main] - bottom)
    near = np.maximum(apart_x, apart_y) < gap
    large = stats[:, cv2.CC_STAT_AREA] >= settings.smallest_part * area.max()
    keep |= near & large
    keep[0] = False
    result[inside] = keep[labels]
    return result
