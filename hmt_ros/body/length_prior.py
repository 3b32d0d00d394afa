"""How the lengths of people vary: a common stature, and proportions of their own.

    l_i = l0_i exp(s + e_i),    s ~ N(0, t^2),  e_i ~ N(0, p_i^2)
    S_l = L0 (t^2 1 1' + diag(p^2)) L0,    L0 = diag(l0)

to first order in the spreads. t is the spread of the stature, p_i that of the proportion of a
length. What is measured on a person holds linear functions of the lengths, H l:

    S_l <- S_l - S_l H' (H S_l H' + R)^-1 H S_l
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.inference.arrays import Array

# Relative standard deviation of the stature over people, where a model file gives none.
STATURE_SPREAD = 0.06


def length_covariance(
    lengths: ArrayLike, proportions: ArrayLike, stature: float = STATURE_SPREAD
) -> Array:
    """Covariance (L, L) of lengths over people, m^2.

    Args:
        lengths: (L,) of the typical person, m.
        proportions: (L,) relative standard deviations, the stature apart.
        stature: relative standard deviation of the stature.

    Raises:
        ValueError: a spread that is not finite, or negative.
    """
    typical, own = (np.asarray(x, dtype=np.float64) for x in (lengths, proportions))
    if not (np.isfinite(stature) and stature >= 0):
        raise ValueError(f'stature_spread must be a number of at least 0, saw {stature}')
    if not (np.isfinite(own).all() and (own >= 0).all()):
        raise ValueError(f'spreads of lengths must be numbers of at least 0, saw {own.tolist()}')
    common = stature * typical
    result: Array = np.diag((own * typical) ** 2) + np.outer(common, common)
    return result


def held(covariance: Array, functions: ArrayLike, sigma: ArrayLike) -> Array:
    """Covariance (L, L) of lengths when linear functions of them are known.

    Args:
        covariance: (L, L) before.
        functions: (M, L) rows H.
        sigma: (M,) standard deviations with which H l are known, more than 0.
    """
    rows = np.asarray(functions, dtype=np.float64)
    noise = np.diag(np.asarray(sigma, dtype=np.float64) ** 2)
    cross = rows @ covariance
    result = covariance - cross.T @ np.linalg.solve(cross @ rows.T + noise, cross)
    symmetric: Array = 0.5 * (result + result.T)
    return symmetric
