"""Image maps, from which `core/sampling.h` interpolates bilinear values and gradients."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class ImageMap(NamedTuple):
    """Values in one or several channels on a window of the pixel grid.

    Attributes:
        values: (C, h, w) float32, h and w at least 2.
        left, top: column and row of the window's first pixel in the whole image.
    """

    values: NDArray[np.float32]
    left: int = 0
    top: int = 0
