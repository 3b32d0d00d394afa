"""Bounded damped Newton method with a trust region, for batches of small problems.

Minimises E(x) subject to lower <= x <= upper (KJS 3.2, VMS 5). Every step minimises the damped
quadratic model in the box,

    g.s + 1/2 s.(H + lambda W) s    subject to    lower - x <= s <= upper - x,

with an active set: variables that the step drives across a limit are fixed at the limit, the step
is solved again for all other variables, and fixed variables that the energy pulls inwards are
released. `TrustRegion` adapts lambda. Each problem has its own lambda and active set, and leaves
the batch when it has converged.

The ratio of actual to predicted decrease sets the damping lambda of the next step [Nielsen, Damping
parameter in Marquardt's method, 1999]:

    rho = (E(x) - E(x + s)) / (m(0) - m(s))

    rho > 0.001:   x <- x + s,   lambda <- lambda max(a, 1 - (2 min(rho, 2) - 1)^3),   nu <- 2
    else:                        lambda <- max(lambda, b) nu,                          nu <- 2 nu
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.core import DAMPING_LIMIT, MIN_FACTOR, MIN_RATIO, box_steps
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import EnergyTerm


@dataclass(frozen=True, eq=False)
class Minimum:
    """Result of `minimise`, one row per problem.

    Attributes:
        x: (N, d) minimisers.
        value, gradient, hessian: value (N,), gradient (N, d) and Hessian (N, d, d) of the energy at
            `x`.
        free: (N, d) False for variables fixed at a limit.
        status: (N,) values of `Status`.
        iterations: (N,) numbers of evaluations after the first.
    """

    x: Array
    value: Array
    gradient: Array
    hessian: Array
    free: NDArray[np.bool_]
    status: NDArray[np.int8]
    iterations: NDArray[np.int32]

    def __getitem__(self, rows: Index) -> Minimum:
        """Select problems."""
        return Minimum(*(part[rows] for part in vars(self).values()))

    def joined(self, other: Minimum) -> Minimum:
        """Concatenate with other results."""
        parts = zip(vars(self).values(), vars(other).values(), strict=True)
        return Minimum(*(np.concatenate(pair) for pair in parts))


def minimise(
    term: EnergyTerm,
    x: ArrayLike,
    lower: ArrayLike = -np.inf,
    upper: ArrayLike = np.inf,
    *,
    step_scale: ArrayLike = 1.0,
    damping: float = 1e-3,
    max_iterations: int = 50,
    tolerance: float = 1e-6,
) -> Minimum:
    """Minimises N problems from their starts x (N, d).

    Args:
        term: energy term; it is evaluated with the rows of problems that have not converged yet.
            `EnergyFunction` wraps a function of points and rows.
        x: starts (N, d), which are projected onto the box.
        lower, upper: limits, (d,), (N, d) or scalar.
        step_scale: (d,) typical step of each variable; W = diag(step_scale^-2).
        damping: first lambda, in units of energy.
        max_iterations: maximum number of evaluations per problem after the first.
        tolerance: predicted decrease of a step below which a problem has converged, in units of
            energy.
    """
    lower, upper = (np.asarray(limit, dtype=np.float64) for limit in (lower, upper))
    x = np.ascontiguousarray(np.clip(np.array(x, dtype=np.float64, ndmin=2), lower, upper))
    n, d = x.shape
    lower, upper = (
        np.ascontiguousarray(np.broadcast_to(limit, (n, d))) for limit in (lower, upper)
    )
    metric = np.full(d, 1.0 / np.asarray(step_scale, dtype=np.float64) ** 2)

    everyone = np.arange(n)
    first = term.energy(x, everyone)
    value, gradient, hessian = (
        np.array(part, dtype=np.float64, order='C') for part in (first.value, *first.derivatives())
    )
    region = TrustRegion(n, damping, limit=DAMPING_LIMIT, least_factor=MIN_FACTOR)
    iterations = np.zeros(n, dtype=np.int32)
    status = np.full(n, Status.ITERATION_LIMIT, dtype=np.int8)
    status[~np.isfinite(value)] = Status.NOT_FINITE

    for _ in range(max_iterations):
        active = everyone[status == Status.ITERATION_LIMIT]
        step, predicted = np.empty((len(active), d)), np.empty(len(active))
        box_steps(
            x, gradient, hessian, lower, upper, region.damping, metric, active, step, predicted
        )
        done = predicted < tolerance
        status[active[done]] = Status.CONVERGED
        active, step, predicted = active[~done], step[~done], predicted[~done]
        if len(active) == 0:
            break
        start, low, high = x[active], lower[active], upper[active]
        trial = np.minimum(np.maximum(start + step, low), high)
        # Rounding must not move a fixed variable off its limit.
        trial = np.where(step <= low - start, low, trial)
        trial = np.where(step >= high - start, high, trial)
        found = term.energy(trial, active)
        iterations[active] += 1
        better = region.accept(active, value[active] - found.value, predicted)
        rows = active[better]
        x[rows], value[rows] = trial[better], found.value[better]
        gradient[rows], hessian[rows] = (part[better] for part in found.derivatives())
        status[region.refuse(active[~better])] = Status.STALLED

    free = ~resting(x, gradient, lower, upper)
    return Minimum(x, value, gradient, hessian, free, status, iterations)


def resting(x: Array, gradient: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Mask (N, d) of variables on a limit that the energy pushes outwards."""
    return ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))


class Status(IntEnum):
    """Reason why a minimisation stopped."""

    CONVERGED = 0  # the predicted decrease, or the gradient on the free variables, is small enough
    ITERATION_LIMIT = 1
    STALLED = 2  # no step of any length decreases the energy
    NOT_FINITE = 3  # the energy at the start is not a number or infinite


class TrustRegion:
    """Adapts the damping of each of N problems.

    Args:
        count: number of problems N.
        damping: first lambda.
        limit: lambda above which a problem has stalled, because no step decreases its energy.
        least_factor: smallest factor a on lambda after an accepted step.
        least_refused: bound b: lambda after a refused step is at least 2 b.

    Attributes:
        damping: (N,) lambda of each problem.
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
        """Return the mask (n,) of accepted steps, and adapt the damping of their problems.

        Args:
            rows: (n,) indices of the problems.
            decrease: (n,) decrease of the energies; values that are not finite are treated as no
                decrease.
            predicted: (n,) predicted decrease, positive.
        """
        ratio = np.where(np.isfinite(decrease), decrease, -np.inf) / predicted
        better: NDArray[np.bool_] = ratio > MIN_RATIO
        taken = rows[better]
        gain = 2.0 * np.minimum(ratio[better], 2.0) - 1.0
        factor = 1.0 - gain * gain * gain
        self.damping[taken] *= np.maximum(self._least_factor, factor)
        self._growth[taken] = 2.0
        return better

    def refuse(self, rows: Index) -> Index:
        """Increase the damping of problems (n,) with refused steps; return stalled problems."""
        self.damping[rows] = np.maximum(self.damping[rows], self._least_refused)
        self.damping[rows] *= self._growth[rows]
        self._growth[rows] *= 2.0
        return rows[self.damping[rows] > self._limit]
