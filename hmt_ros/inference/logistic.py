"""Conversion between probabilities and log odds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array


def log_odds(probability: ArrayLike) -> Array:
    """Log odds log(p / (1 - p)) of probabilities; infinite at 0 and 1."""
    p = np.asarray(probability, dtype=np.float64)
    with np.errstate(divide='ignore'):
        result: Array = elementary.log(p) - elementary.log1p(-p)
    return result


def probability_of(odds: ArrayLike) -> Array:
    """Probabilities 1 / (1 + exp(-x)) from log odds x."""
    x = np.asarray(odds, dtype=np.float64)
    e = elementary.exp(-np.abs(x))
    return np.asarray(np.where(x < 0.0, e, 1.0) / (1.0 + e))
