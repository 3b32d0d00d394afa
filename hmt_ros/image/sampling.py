"""Image maps, in which `core/sampling.h` interpolates values and gradients bilinearly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class ImageMap(NamedTuple):
    """Values on a window of the pixel grid, in one or several channels.

    Attributes:
        values: (C, h, w) float32, h and w at least 2.
        left, top: column and row of the window's first pixel in the whole image.
    """

    values: NDArray[np.float32]
    left: int = 0
    top: int = 0
