"""Bounded damped Newton with a trust region, for a batch of small problems at once.

Minimises E(x) subject to lower <= x <= upper (KJS 3.2, VMS 5): every iteration solves

    (H + lambda W) step = -g

on the free variables, projects the step onto the box, and moves lambda by the ratio of the actual
to the predicted decrease. A variable rests on its limit as long as the gradient pushes it outwards.
Each problem has its own lambda and its own active set, and leaves the batch when it has converged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.inference.box_step import DAMPING_LIMIT, box_steps
from hmt_ros.inference.energy import EnergyFunction, EnergyTerm
from hmt_ros.inference.trust_region import Status, TrustRegion

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Minimum:
    """Result of `minimise`, one row a problem.

    Attributes:
        x: (N, d) minimiser.
        value, gradient, hessian: (N,), (N, d), (N, d, d) of the energy there.
        free: (N, d) variables that do not rest on a limit.
        status: (N,) of `Status`.
        iterations: (N,) evaluations after the first.
    """

    x: Array
    value: Array
    gradient: Array
    hessian: Array
    free: NDArray[np.bool_]
    status: NDArray[np.int8]
    iterations: NDArray[np.int32]

    def __getitem__(self, rows: Index) -> Minimum:
        """Some of them."""
        return Minimum(*(getattr(self, f.name)[rows] for f in fields(Minimum)))

    def joined(self, other: Minimum) -> Minimum:
        """These and others."""
        parts = ((getattr(self, f.name), getattr(other, f.name)) for f in fields(Minimum))
        return Minimum(*(np.concatenate(pair) for pair in parts))


def minimise(
    term: EnergyTerm | Callable[[Array, Index], tuple[Array, Array, Array]],
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
        term: the energy; rows are those of the N problems that have not converged yet. A function
            of points and rows that returns value, gradient and Hessian will do.
        x: starts (N, d); projected onto the box.
        lower, upper: limits (d,) or (N, d), or scalars.
        step_scale: (d,) length of a step that is moderate for each variable;
            W = diag(step_scale^-2).
        damping: first lambda, in units of energy.
        max_iterations: evaluations per problem after the first one.
        tolerance: converged when a step is predicted to gain less than this, in units of energy.
    """
    if callable(term):
        term = EnergyFunction(term)
    lower, upper = (np.asarray(limit, dtype=np.float64) for limit in (lower, upper))
    x = np.clip(np.array(x, dtype=np.float64, ndmin=2), lower, upper)
    n, d = x.shape
    lower, upper = (np.broadcast_to(limit, (n, d)) for limit in (lower, upper))
    metric = np.broadcast_to(np.asarray(step_scale, dtype=np.float64) ** -2.0, (d,))

    everyone = np.arange(n)
    first = term.energy(x, everyone)
    value, gradient, hessian = (np.array(p) for p in (first.value, *first.derivatives()))
    region = TrustRegion(n, damping, limit=DAMPING_LIMIT, least_factor=1.0 / 3.0)
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
        # Rounding must not leave a variable a hair away from the limit it was put on.
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
    """Variables (N, d) on a limit with a gradient of the energy that pushes them outwards."""
    result: NDArray[np.bool_] = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
    return result
