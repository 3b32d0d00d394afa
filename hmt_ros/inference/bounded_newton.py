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
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.inference.box_step import DAMPING_LIMIT, box_steps

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# objective(x (n, d), problem (n,)) -> value (n,), gradient (n, d), Hessian (n, d, d); `problem`
# says which of the N problems each row belongs to, as converged ones are left out.
Objective = Callable[[Array, Index], tuple[Array, Array, Array]]


class Status(IntEnum):
    """Why a minimisation stopped."""

    CONVERGED = 0  # the predicted decrease, or the gradient on the free variables, is small enough
    ITERATION_LIMIT = 1
    STALLED = 2  # no step of any length decreases the energy
    NOT_FINITE = 3  # the energy at the start is not a number or infinite


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
    objective: Objective,
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
        objective: value, gradient and Hessian (exact or Gauss-Newton) for some of the problems.
        x: starts (N, d); projected onto the box.
        lower, upper: limits (d,) or (N, d), or scalars.
        step_scale: (d,) length of a step that is moderate for each variable;
            W = diag(step_scale^-2).
        damping: first lambda, in units of energy.
        max_iterations: evaluations per problem after the first one.
        tolerance: converged when a step is predicted to gain less than this, in units of energy.
    """
    objective = getattr(objective, 'energy', objective)
    lower, upper = (np.asarray(limit, dtype=np.float64) for limit in (lower, upper))
    x = np.clip(np.array(x, dtype=np.float64, ndmin=2), lower, upper)
    n, d = x.shape
    lower, upper = (np.broadcast_to(limit, (n, d)) for limit in (lower, upper))
    metric = np.broadcast_to(np.asarray(step_scale, dtype=np.float64) ** -2.0, (d,))

    everyone = np.arange(n)
    value, gradient, hessian = (np.array(part) for part in objective(x, everyone))
    lam = np.full(n, float(damping))
    growth = np.full(n, 2.0)
    iterations = np.zeros(n, dtype=np.int32)
    status = np.full(n, Status.ITERATION_LIMIT, dtype=np.int8)
    status[~np.isfinite(value)] = Status.NOT_FINITE

    active = everyone[np.isfinite(value)]
    for _ in range(max_iterations):
        if len(active) == 0:
            break
        start, low, high = x[active], lower[active], upper[active]
        step, predicted = np.empty_like(start), np.empty(len(active))
        box_steps(x, gradient, hessian, lower, upper, lam, metric, active, step, predicted)
        done = predicted < tolerance
        if done.any():
            status[active[done]] = Status.CONVERGED
            active = active[~done]
            if len(active) == 0:
                break
            start, low, high = start[~done], low[~done], high[~done]
            step, predicted = step[~done], predicted[~done]

        trial = np.minimum(np.maximum(start + step, low), high)
        # Rounding must not leave a variable a hair away from the limit it was put on.
        trial = np.where(step <= low - start, low, trial)
        trial = np.where(step >= high - start, high, trial)
        new_value, new_gradient, new_hessian = objective(trial, active)
        iterations[active] += 1
        decrease = value[active] - new_value
        ratio = np.where(np.isfinite(decrease), decrease, -np.inf) / predicted
        better = ratio > 1e-3

        rows = active[better]
        x[rows] = trial[better]
        value[rows] = new_value[better]
        gradient[rows] = new_gradient[better]
        hessian[rows] = new_hessian[better]
        # Nielsen's rule: smooth in the ratio, and ever faster while steps are refused.
        lam[rows] *= np.maximum(1.0 / 3.0, 1.0 - (2.0 * np.minimum(ratio[better], 2.0) - 1.0) ** 3)
        growth[rows] = 2.0
        rows = active[~better]
        lam[rows] *= growth[rows]
        growth[rows] *= 2.0
        stalled = lam > DAMPING_LIMIT
        status[stalled] = Status.STALLED
        active = active[~stalled[active]]

    free = ~resting(x, gradient, lower, upper)
    return Minimum(x, value, gradient, hessian, free, status, iterations)


def resting(x: Array, gradient: Array, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Variables (N, d) on a limit with a gradient of the energy that pushes them outwards."""
    result: NDArray[np.bool_] = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
    return result
