"""Covariances of modes: inverse Hessians on the variables that do not rest on their limits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Largest standard deviation of a mode: where an image shows nothing, rad or m.
WIDEST = 2.0
# Of a variable that rests on its limit, rad or m: 3 degrees.
AT_LIMIT = 0.05


def free_covariances(hessians: Array, free: NDArray[np.bool_]) -> Array:
    """Inverses (K, d, d) of Hessians (K, d, d) on the free variables (K, d).

    A variable at its limit has the deviation `AT_LIMIT`, and none one above `WIDEST`.
    """
    h = hessians.copy()
    rows, dofs = np.nonzero(~free)
    h[rows, dofs, :] = 0.0
    h[rows, :, dofs] = 0.0
    h[rows, dofs, dofs] = AT_LIMIT**-2.0
    diagonal = np.arange(h.shape[1])
    h[:, diagonal, diagonal] += WIDEST**-2.0
    result = np.linalg.inv(0.5 * (h + h.transpose(0, 2, 1)))
    return 0.5 * (result + result.transpose(0, 2, 1))
