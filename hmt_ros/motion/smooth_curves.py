"""Smooth curves over time, of which motions are made."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import minimum_filter1d, uniform_filter1d

Array = NDArray[np.float64]


def minimum_jerk(share: Array) -> Array:
    """The step from 0 to 1, over a share of the time from 0 to 1, with the least jerk."""
    result: Array = share**3 * (10.0 + share * (6.0 * share - 15.0))
    return result


def rests(time: Array, times: ArrayLike, values: ArrayLike) -> Array:
    """Values (T,) that go from one to the next by minimum jerk and rest at each.

    Args:
        time: (T,).
        times: (n,) of the rests, increasing; before the first and after the last nothing moves.
        values: (n,) at the rests.
    """
    at, value = np.asarray(times, dtype=np.float64), np.asarray(values, dtype=np.float64)
    after = np.clip(np.searchsorted(at, time, side='right'), 1, len(at) - 1)
    share = np.clip((time - at[after - 1]) / (at[after] - at[after - 1]), 0.0, 1.0)
    result: Array = value[after - 1] + minimum_jerk(share) * (value[after] - value[after - 1])
    return result


def cubic(share: Array, start: float, slope: float, end: Array | float) -> Array:
    """The cubic with a value and a slope at 0, and a value and no slope at 1."""
    u, v = share, 1.0 - share
    result: Array = (1 + 2 * u) * v * v * start + u * v * v * slope + u * u * (3 - 2 * u) * end
    return result


def smooth_below(limit: Array, half_width: int) -> Array:
    """A smooth curve (T,) that nowhere exceeds a limit (T,).

    Args:
        limit: (T,).
        half_width: of each of three moving averages, in samples.
    """
    # The averages together reach three half-widths to each side, and so does the minimum.
    lowest = minimum_filter1d(limit, 6 * half_width + 1, mode='nearest')
    for _ in range(3):
        lowest = uniform_filter1d(lowest, 2 * half_width + 1, mode='nearest')
    return np.asarray(lowest, dtype=np.float64)
