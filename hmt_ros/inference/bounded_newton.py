"""Bounded damped Newton with a trust region, for a batch of small problems at once.

Minimises E(x) subject to lower <= x <= upper (KJS 3.2, VMS 5). Every step minimises the damped
quadratic model in the box,

    g.s + 1/2 s.(H + lambda W) s    subject to    lower - x <= s <= upper - x,

by an active set: variables that the step drives across a limit are put on it, the others are solved
again, and variables that are pulled away from their limit are set free. `TrustRegion` moves lambda.
Each problem has its own lambda and its own active set, and leaves the batch when it has converged.

The damping shows how far the model is trusted: the fraction of the predicted decrease that comes
true sets lambda for the next step [Nielsen, Damping parameter in Marquardt's method, 1999]:

    rho = (E(x) - E(x + s)) / (m(0) - m(s))

    rho > 0.001:   x <- x + s,   lambda <- lambda max(a, 1 - (2 min(rho, 2) - 1)^3),   nu <- 2
    else:                        lambda <- max(lambda, b) nu,                          nu <- 2 nu
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import EnergyTerm

DAMPING_LIMIT = 1e12
# A damping shrinks by at most this factor.
LEAST_FACTOR = 1.0 / 3.0


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
    lower, upper = (np.asarray(limit, dtype=np.float64) for limit in (lower, upper))
    x = np.clip(np.array(x, dtype=np.float64, ndmin=2), lower, upper)
    n, d = x.shape
    # Copies: kernels are compiled again for every layout and for read-only arrays.
    lower, upper = (np.array(np.broadcast_to(limit, (n, d)), order='C') for limit in (lower, upper))
    metric = np.full(d, np.asarray(step_scale, dtype=np.float64) ** -2.0)

    everyone = np.arange(n)
    first = term.energy(x, everyone)
    value, gradient, hessian = (np.array(p) for p in (first.value, *first.derivatives()))
    region = TrustRegion(n, damping, limit=DAMPING_LIMIT, least_factor=LEAST_FACTOR)
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
    return ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))


@njit(cache=True, nogil=True, error_model='numpy')
def box_steps(  # type: ignore[no-untyped-def]
    x, gradient, hessian, lower, upper, lam, metric, rows, step, predicted
):
    """Steps from the points of some problems, and the decrease that the undamped model predicts.

    Where the limits have spoilt a step so that it gains nothing, steepest descent stands in.

    Args:
        x, gradient, hessian, lower, upper: (N, d), (N, d), (N, d, d), (N, d), (N, d).
        lam: (N,) damping; more where the Hessian is not positive definite.
        metric: (d,) diagonal of W.
        rows: (n,) the problems.
        step: (n, d) becomes the steps.
        predicted: (n,) becomes the decrease.
    """
    d = x.shape[1]
    low, high, curve = np.empty(d), np.empty(d), np.empty(d)
    for k in range(len(rows)):
        n = rows[k]
        for i in range(d):
            low[i], high[i] = lower[n, i] - x[n, i], upper[n, i] - x[n, i]
        predicted[k] = box_step(gradient[n], hessian[n], low, high, lam[n], metric, step[k], curve)


@njit(cache=True, nogil=True, error_model='numpy')
def box_step(gradient, hessian, low, high, damping, metric, step, curve):  # type: ignore[no-untyped-def]
    """One step (d,) in a box around 0, and the decrease that is predicted; see `box_steps`."""
    _box_step(gradient, hessian, low, high, damping, metric, step)
    predicted = _decrease(gradient, hessian, step, curve)
    if predicted <= 0.0:
        predicted = _descent_step(gradient, hessian, low, high, metric, step, curve)
    return predicted


@njit(cache=True, nogil=True, error_model='numpy')
def _decrease(gradient, hessian, step, curve):  # type: ignore[no-untyped-def]
    """Decrease that the quadratic model predicts for a step; `curve` becomes H step."""
    count = len(step)
    curve[:] = 0.0
    for j in range(count):  # along rows of a symmetric matrix: so the compiler takes many at once
        moved = step[j]
        for i in range(count):
            curve[i] += hessian[j, i] * moved
    total = 0.0
    for i in range(count):
        total -= step[i] * (gradient[i] + 0.5 * curve[i])
    return total


@njit(cache=True, nogil=True, error_model='numpy')
def _box_step(gradient, hessian, low, high, shift, metric, step):  # type: ignore[no-untyped-def]
    """Sets the step to the minimiser of the damped model in the box."""
    d = len(gradient)
    bound = np.empty(d, np.bool_)
    solution, curve, best = np.empty(d), np.empty(d), np.zeros(d)
    factor, free = np.empty((d, d)), np.empty(d, np.int64)
    largest, least = 0.0, np.inf
    for i in range(d):
        bound[i] = (low[i] >= 0.0 and gradient[i] > 0.0) or (high[i] <= 0.0 and gradient[i] < 0.0)
        step[i] = min(max(0.0, low[i]), high[i]) if bound[i] else 0.0
        least = min(least, metric[i])
        for j in range(d):
            largest = max(largest, abs(hessian[i, j]))
    best_gain = -np.inf
    for _ in range(3 * d + 3):
        count = 0
        for i in range(d):
            if not bound[i]:
                free[count] = i
                count += 1
        while not _solve(
            gradient, hessian, shift, metric, bound, free, count, step, factor, solution
        ):
            if shift > DAMPING_LIMIT:
                break
            # Not positive definite: the least shift that Gershgorin asks for is far too careful.
            shift = max(4.0 * shift, 1e-3 * largest / least)
        across = False
        for c in range(count):
            i = free[c]
            step[i] = solution[c]
            if step[i] < low[i] or step[i] > high[i]:
                across = True
                bound[i] = True
                step[i] = min(max(step[i], low[i]), high[i])
        if count == d and not across:
            return
        gain = _decrease(gradient, hessian, step, curve)
        if gain > best_gain:
            best_gain = gain
            best[:] = step
        if across:
            continue
        worst, released = 0.0, -1
        for i in range(d):
            if bound[i] and low[i] < high[i]:
                slope = gradient[i] + curve[i] + shift * metric[i] * step[i]
                away = (step[i] <= low[i] and slope < 0.0) or (step[i] >= high[i] and slope > 0.0)
                if away and abs(slope) > worst:
                    worst, released = abs(slope), i
        if released < 0:
            return
        bound[released] = False
    step[:] = best


@njit(cache=True, nogil=True, error_model='numpy')
def _solve(  # type: ignore[no-untyped-def]
    gradient, hessian, shift, metric, bound, free, count, step, factor, solution
):
    """Solves the damped model for the free variables, the bound ones at their steps.

    By a Cholesky factorisation that runs along rows; False where the matrix is not positive
    definite.
    """
    for a in range(count):
        i = free[a]
        for b in range(a, count):
            factor[a, b] = hessian[i, free[b]]
        factor[a, a] += shift * metric[i]
        right = -gradient[i]
        for j in range(len(step)):
            if bound[j]:
                right -= hessian[i, j] * step[j]
        solution[a] = right
    positive = True
    for a in range(count):
        pivot = factor[a, a]
        if not pivot > 0.0:
            positive = False
            pivot = 1.0
        root = 1.0 / np.sqrt(pivot)
        for b in range(a, count):
            factor[a, b] *= root
        solution[a] *= root
        for c in range(a + 1, count):
            scale = factor[a, c]
            solution[c] -= scale * solution[a]
            if scale != 0.0:
                for b in range(c, count):
                    factor[c, b] -= scale * factor[a, b]
        if not positive:
            return False
    for a in range(count - 1, -1, -1):
        total = solution[a]
        for b in range(a + 1, count):
            total -= factor[a, b] * solution[b]
        solution[a] = total / factor[a, a]
    return True


@njit(cache=True, nogil=True, error_model='numpy')
def _descent_step(  # type: ignore[no-untyped-def]
    gradient, hessian, low, high, metric, step, curve
):
    """Sets the step to steepest descent in the metric, projected onto the box; returns its gain."""
    d = len(gradient)
    direction = np.empty(d)
    slope = 0.0
    for i in range(d):
        resting = (low[i] >= 0.0 and gradient[i] > 0.0) or (high[i] <= 0.0 and gradient[i] < 0.0)
        direction[i] = 0.0 if resting else -gradient[i] / metric[i]
        slope -= direction[i] * gradient[i]
    curvature = slope - _decrease(gradient, hessian, direction, curve)
    curvature *= 2.0
    length = slope / curvature if curvature > 0.0 else 1.0
    gain = 0.0
    for _ in range(60):
        for i in range(d):
            step[i] = min(max(length * direction[i], low[i]), high[i])
        gain = _decrease(gradient, hessian, step, curve)
        if gain > 0.0 or slope <= 0.0:
            break
        length *= 0.5
    return gain


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
        """Mask (n,) of the steps that are to be taken; their dampings follow.

        Args:
            rows: (n,) the problems.
            decrease: (n,) of their energies; values that are not finite are no decrease.
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
        """Damps problems (n,) whose steps are refused; returns those that have stalled."""
        self.damping[rows] = np.maximum(self.damping[rows], self._least_refused)
        self.damping[rows] *= self._growth[rows]
        self._growth[rows] *= 2.0
        return rows[self.damping[rows] > self._limit]
