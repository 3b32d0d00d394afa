"""Random numbers with the same bytes on every processor."""

from __future__ import annotations

import numpy as np

from hmt_ros.inference.arrays import Array

# Where the ziggurat of numpy's normals ends. It takes numbers beyond from a logarithm of the C
# library, which depends on the processor.
_END = 3.6541528853610088


def standard_normals(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Numbers of a normal distribution, except that three in 10 000 lie beyond and are `_END`."""
    return np.clip(rng.standard_normal(shape), -_END, _END)
