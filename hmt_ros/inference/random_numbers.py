"""Random numbers that are bit-identical on every processor."""

from __future__ import annotations

import numpy as np

from hmt_ros.inference.arrays import Array

# End of the ziggurat of numpy's normal numbers. For larger numbers, numpy calls the C library's
# logarithm, whose result depends on the processor.
_ZIGGURAT_END = 3.6541528853610088


def standard_normals(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Draw standard normal numbers, clipped at +-`_ZIGGURAT_END` (3 of 10 000 are clipped)."""
    return np.clip(rng.standard_normal(shape), -_ZIGGURAT_END, _ZIGGURAT_END)
