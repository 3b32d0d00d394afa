"""How far the quadratic model of an energy is trusted: the damping of Newton steps.

A step s solves (H + lambda W) s = -g. How much of the decrease that the model predicts comes true
says what lambda is for the next step [Nielsen, Damping parameter in Marquardt's method, 1999]:

    rho = (E(x) - E(x + s)) / (m(0) - m(s))

    rho > 0.001:   x <- x + s,   lambda <- lambda max(a, 1 - (2 min(rho, 2) - 1)^3),   nu <- 2
    else:                        lambda <- max(lambda, b) nu,                          nu <- 2 nu
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Array, Index

# Least share of the predicted decrease for which a step is taken.
LEAST_RATIO = 1e-3


class Status(IntEnum):
    """Why a minimisation stopped."""

    CONVERGED = 0  # the predicted decrease, or the gradient on the free variables, is small enough
    ITERATION_LIMIT = 1
    STALLED = 2  # no step of any length decreases the energy
    NOT_FINITE = 3  # the energy at the start is not a number or infinite


class TrustRegion:
    """The dampings of N problems, each with its own.

    Args:
        count: N.
        damping: first lambda.
        limit: no step decreases the energy of a problem whose lambda is above it.
        least_factor: a, lambda shrinks by at most this factor.
        least_refused: b, lambda after a refused step is at least twice this.

    Attributes:
        damping: (N,) lambda.
    """

    def __init__(
        self,
        count: int,
        damping: float,
        *,
        limit: float,
        least_factor: float,
        least_refused: float = 0.0,
    ) -> None:
        self.damping = np.full(count, float(damping))
        self._growth = np.full(count, 2.0)
        self._limit, self._least_factor, self._least_refused = limit, least_factor, least_refused

    def accept(self, rows: Index, decrease: Array, predicted: Array) -> NDArray[np.bool_]:
        """Which steps are to be taken, (n,); their dampings follow.

        Args:
            rows: (n,) the problems.
            decrease: (n,) of their energies; what is not finite is no decrease.
            predicted: (n,) decrease, positive.
        """
        ratio = np.where(np.isfinite(decrease), decrease, -np.inf) / predicted
        better: NDArray[np.bool_] = ratio > LEAST_RATIO
        taken = rows[better]
        factor = 1.0 - (2.0 * np.minimum(ratio[better], 2.0) - 1.0) ** 3
        self.damping[taken] *= np.maximum(self._least_factor, factor)
        self._growth[taken] = 2.0
        return better

    def refuse(self, rows: Index) -> Index:
        """Damps problems (n,) whose steps are refused; those of them that have stalled."""
        self.damping[rows] = np.maximum(self.damping[rows], self._least_refused)
        self.damping[rows] *= self._growth[rows]
        self._growth[rows] *= 2.0
        return rows[self.damping[rows] > self._limit]
