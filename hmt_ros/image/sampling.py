"""Bilinear values and gradients of image maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray


class ImageMap(NamedTuple):
    """Values on a window of the pixel grid, of one or several channels.

    Attributes:
        values: (C, h, w) float32, h and w at least 2.
        left, top: column and row of the window's first pixel in the whole image.
    """

    values: NDArray[np.float32]
    left: int = 0
    top: int = 0


@njit(cache=True, nogil=True, inline='always')
def sample(values, left, top, channel, u, v):  # type: ignore[no-untyped-def]
    """Value and its derivatives by u and v at a pixel of the whole image, of an `ImageMap`.

    Outside the window the nearest value is continued.
    """
    h, w = values.shape[1], values.shape[2]
    x, y = u - left, v - top
    cx, cy = min(max(x, 0.0), w - 1.001), min(max(y, 0.0), h - 1.001)
    i, j = int(cy), int(cx)
    dv, du = cy - i, cx - j
    a, b = values[channel, i, j], values[channel, i, j + 1]
    p, q = values[channel, i + 1, j], values[channel, i + 1, j + 1]
    upper = a + (b - a) * du
    lower = p + (q - p) * du
    value = upper + (lower - upper) * dv
    slope_u = (b - a) * (1.0 - dv) + (q - p) * dv
    slope_v = lower - upper
    if x < 0.0 or x > w - 1.0:
        slope_u = 0.0
    if y < 0.0 or y > h - 1.0:
        slope_v = 0.0
    return value, slope_u, slope_v


@njit(cache=True, nogil=True, inline='always')
def sample_distance(values, left, top, channel, u, v):  # type: ignore[no-untyped-def]
    """`sample` of a map of distances, continued outside its window by the way to the window."""
    value, slope_u, slope_v = sample(values, left, top, channel, u, v)
    h, w = values.shape[1], values.shape[2]
    x, y = u - left, v - top
    if x < 0.0:
        value, slope_u = value - x, -1.0
    elif x > w - 1.0:
        value, slope_u = value + (x - w + 1.0), 1.0
    if y < 0.0:
        value, slope_v = value - y, -1.0
    elif y > h - 1.0:
        value, slope_v = value + (y - h + 1.0), 1.0
    return value, slope_u, slope_v
