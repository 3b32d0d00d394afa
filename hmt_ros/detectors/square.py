"""Square crops of an image as network inputs, and mapping of network outputs to the image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array, Image
from hmt_ros.inference.linear_algebra import product

# Ratio of a square's side to the diameter or extent of its content.
_MARGIN = 1.25

Float = TypeVar('Float', np.float32, np.float64)
Values = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Square:
    """A square of the image: centre, px, side, px, and rotation, rad."""

    centre: tuple[float, float]
    side: float
    angle: float

    @classmethod
    def about(cls, circle: Array) -> Square:
        """Square around a circle (centre and a point, (2, 2)), rotated to put the point on top."""
        centre, (along, down) = circle[0], circle[1] - circle[0]
        side = 2 * _MARGIN * math.hypot(along, down)
        return cls((centre[0], centre[1]), side, float(elementary.arctan2(along, -down)))

    @classmethod
    def around(cls, points: Array) -> Square:
        """The upright square around points (n, 2)."""
        low, high = points.min(axis=0), points.max(axis=0)
        middle = (low + high) / 2
        return cls((middle[0], middle[1]), _MARGIN * float((high - low).max()), 0.0)

    @property
    def axes(self) -> Array:
        """Unit vectors (2, 2), in rows, to the right and downwards in the square."""
        c, s = float(elementary.cos(self.angle)), float(elementary.sin(self.angle))
        return np.array([[c, s], [-s, c]])

    @property
    def corner(self) -> Array:
        """Upper left corner (2,), px."""
        result: Array = self.centre - self.axes.sum(axis=0) * (self.side / 2)
        return result

    def seen(self, image: Image, size: int, border: int) -> Image:
        """The part of the image in the square, resampled to (size, size, 3) RGB."""
        matrix = np.column_stack([self.axes.T * (self.side / size), self.corner])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        result = cv2.warpAffine(image, matrix, (size, size), flags=flags, borderMode=border)
        return np.asarray(result[..., ::-1], np.uint8)

    def spread(self, values: Values, size: tuple[int, int]) -> Values:
        """Maps values (n, n) in the square to an image of `size` (H, W)."""
        to_square = self.axes * (len(values) / self.side)
        matrix = np.column_stack([to_square, product(-to_square, self.corner)])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpAffine(values, matrix, size[::-1], flags=flags), np.float32)


def sigmoid(x: NDArray[Float]) -> NDArray[Float]:
    """Converts logits to probabilities."""
    # Clip logits so that exp does not overflow.
    result: NDArray[Float] = 1 / (1 + elementary.exp(-x.clip(-80, 80)))
    return result
