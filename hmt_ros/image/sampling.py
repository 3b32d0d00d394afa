"""Bilinear values and gradients of image maps at many points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Map = NDArray[np.float32]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ImageMap:
    """Values on a window of the pixel grid, of one or several channels.

    Attributes:
        values: (C, h, w) float32.
        left, top: column and row of the window's first pixel in the whole image.
    """

    values: Map
    left: int = 0
    top: int = 0

    def sample(self, pixels: Array, channels: Index | int = 0) -> tuple[Array, Array]:
        """Values and gradients at pixels.

        Args:
            pixels: (2, ...) column and row in the whole image; NaN gives the value of the corner.
            channels: which channel at each pixel.

        Returns:
            values (...) and gradients (2, ...). Outside the window the nearest value is continued and
            its gradient is zero.
        """
        c, h, w = self.values.shape
        u = pixels[0] - self.left
        v = pixels[1] - self.top
        inside_u = (u >= 0) & (u <= w - 1)
        inside_v = (v >= 0) & (v <= h - 1)
        u = np.clip(np.nan_to_num(u, nan=0.0), 0.0, w - 1.001)
        v = np.clip(np.nan_to_num(v, nan=0.0), 0.0, h - 1.001)
        column = u.astype(np.intp)
        row = v.astype(np.intp)
        du, dv = u - column, v - row
        flat = self.values.reshape(-1)
        index = (np.asarray(channels) * h + row) * w + column
        a, b = flat[index], flat[index + 1]
        p, q = flat[index + w], flat[index + w + 1]
        top = a + (b - a) * du
        bottom = p + (q - p) * du
        gradient = np.empty((2, *u.shape))
        gradient[0] = ((b - a) * (1 - dv) + (q - p) * dv) * inside_u
        gradient[1] = (bottom - top) * inside_v
        return top + (bottom - top) * dv, gradient
