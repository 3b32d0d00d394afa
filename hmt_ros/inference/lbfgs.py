"""L-BFGS: minimisation with gradients, and a line search for the strong Wolfe conditions.

    d = -H g,   H from the last pairs of steps and changes of the gradient      [Nocedal, 1980]
    f(x + a d) <= f(x) + 1e-3 a g.d,   |g(x + a d).d| <= 0.9 |g.d|        [More, Thuente, 1994]

The iterates equal the iterates of L-BFGS-B without bounds. The library L-BFGS-B is not used,
because it calls BLAS, whose sums depend on the processor.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from hmt_ros.inference.arrays import Array

DECREASE, CURVATURE, MIN_BRACKET = 1e-3, 0.9, 0.1
MAX_STEP = 1e10
MAX_LINE_SEARCH_STEPS = 20  # maximum number of evaluations in one line search
# Convergence thresholds: relative decrease of the value, maximum absolute gradient component.
MIN_DECREASE, MIN_GRADIENT = 1e7 * np.finfo(np.float64).eps, 1e-5

Function = Callable[[Array], tuple[float, Array]]


def descent(
    function: Function, start: Array, *, memory: int, most_evaluations: int
) -> Iterator[tuple[Array, float]]:
    """Yield each iterate and its value, until the value stops decreasing.

    Args:
        function: function that returns value and gradient (n,) at a point (n,).
        start: (n,) first point.
        memory: maximum number of stored pairs of steps and gradient changes.
        most_evaluations: number of evaluations after which the descent ends.
    """
    x = start
    value, gradient = function(x)
    pairs: list[tuple[Array, Array, float]] = []
    evaluations, first = 1, True
    while np.abs(gradient).max(initial=0.0) > MIN_GRADIENT and evaluations <= most_evaluations:
        direction = -_product(pairs, gradient)
        slope = _dot(direction, gradient)
        search = LineSearch(
            value, slope, 1.0 / math.sqrt(_dot(direction, direction)) if first else 1.0
        )
        while slope < 0.0 and not search.ended and search.count < MAX_LINE_SEARCH_STEPS:
            there = x + search.step * direction
            found, changed = function(there)
            evaluations += 1
            search.advance(found, _dot(changed, direction))
        if not search.found:
            if not pairs:
                return
            pairs, first = [], True
            continue
        first = False
        step, change = search.step * direction, changed - gradient
        curvature = _dot(step, change)
        if curvature > np.finfo(np.float64).eps * -slope * search.step:
            pairs = [*pairs, (step, change, curvature)][-memory:]
        fall = value - found
        x, value, gradient = there, found, changed
        yield x, value
        if fall <= MIN_DECREASE * max(abs(value + fall), abs(value), 1.0):
            return


def _dot(a: Array, b: Array) -> float:
    return float((a * b).sum())


def _product(pairs: list[tuple[Array, Array, float]], gradient: Array) -> Array:
    """Product H g of the inverse Hessian approximation and the gradient."""
    result, shares = gradient.copy(), []
    for step, change, curvature in reversed(pairs):
        shares.append(_dot(step, result) / curvature)
        result -= shares[-1] * change
    if pairs:
        _, change, curvature = pairs[-1]
        result *= curvature / _dot(change, change)
    for step, change, curvature in pairs:
        result += (shares.pop() - _dot(change, result) / curvature) * step
    return result


@dataclass(frozen=True)
class _At:
    """Value and slope at a step."""

    step: float
    value: float
    slope: float

    def less(self, slope: float) -> _At:
        """Subtracts a line of the given slope from the function."""
        return _At(self.step, self.value - self.step * slope, self.slope - slope)


class LineSearch:
    """A line search: the caller evaluates `step` and passes value and slope to `advance`.

    Attributes:
        step: next step to evaluate, or the step that was found.
        found: whether the step satisfies the conditions.
        ended: whether the search is over.
        count: number of evaluations.
    """

    def __init__(self, value: float, slope: float, step: float) -> None:
        self.step, self.found, self.ended, self.count = step, False, False, 0
        self._start = self._best = self._other = _At(0.0, value, slope)
        self._bracketed, self._modified = False, True
        self._range = (0.0, 5.0 * step)
        self._width, self._before = MAX_STEP, 2.0 * MAX_STEP

    def advance(self, value: float, slope: float) -> None:
        """Advances the search with the value and the slope at `step`."""
        self.count += 1
        here, test = _At(self.step, value, slope), DECREASE * self._start.slope
        low, high = self._range
        lower = here.value <= self._start.value + here.step * test
        if self._modified and lower and here.slope >= 0.0:
            self._modified = False
        flat = abs(slope) <= CURVATURE * -self._start.slope
        stuck = self._bracketed and (not low < here.step < high or high - low <= MIN_BRACKET * high)
        at_end = here.step == MAX_STEP and lower and here.slope <= test
        if (lower and flat) or stuck or at_end:
            # L-BFGS also accepts the last step of a search that cannot continue.
            self.found = self.ended = True
            return
        shift = test if self._modified and here.value <= self._best.value and not lower else 0.0
        best, other, step, self._bracketed = _next(
            self._best.less(shift),
            self._other.less(shift),
            here.less(shift),
            self._bracketed,
            low,
            high,
        )
        self._best, self._other = best.less(-shift), other.less(-shift)
        x, y = self._best.step, self._other.step
        if self._bracketed:
            if abs(y - x) >= 0.66 * self._before:
                step = x + 0.5 * (y - x)
            self._before, self._width = self._width, abs(y - x)
            low, high = min(x, y), max(x, y)
        else:
            low, high = step + 1.1 * (step - x), step + 4.0 * (step - x)
        step = min(max(step, 0.0), MAX_STEP)
        if self._bracketed and (not low < step < high or high - low <= MIN_BRACKET * high):
            step = x
        self.step, self._range = step, (low, high)


def _next(
    best: _At, other: _At, here: _At, bracketed: bool, low: float, high: float
) -> tuple[_At, _At, float, bool]:
    """Both ends of the new interval, the next step, and whether the interval brackets a minimum."""
    opposite = here.slope * math.copysign(1.0, best.slope) < 0.0
    far = here.step - best.step
    secant = (
        here.step - here.slope / (here.slope - best.slope) * far
        if here.slope != best.slope
        else math.inf
    )
    if here.value > best.value:
        theta, gamma = _cubic(best, here, here.step < best.step)
        r = (gamma - best.slope + theta) / (gamma - best.slope + gamma + here.slope)
        cubic = best.step + r * far
        mean = (best.value - here.value) / far + best.slope
        quadratic = best.step + 0.5 * best.slope / mean * far
        near = abs(cubic - best.step) < abs(quadratic - best.step)
        return best, here, cubic if near else cubic + 0.5 * (quadratic - cubic), True
    if opposite:
        theta, gamma = _cubic(best, here, here.step > best.step)
        r = (gamma - here.slope + theta) / (gamma - here.slope + gamma + best.slope)
        cubic = here.step - r * far
        farther = abs(cubic - here.step) > abs(secant - here.step)
        return here, best, cubic if farther else secant, True
    ends = (here, other, bracketed)
    if abs(here.slope) < abs(best.slope):
        theta, gamma = _cubic(best, here, here.step > best.step)
        r = (gamma - here.slope + theta) / (gamma + (best.slope - here.slope) + gamma)
        if r < 0.0 and gamma != 0.0:
            cubic = here.step - r * far
        else:
            cubic = high if here.step > best.step else low
        near = abs(cubic - here.step) < abs(secant - here.step)
        if bracketed:
            step = cubic if near else secant
            limit = here.step + 0.66 * (other.step - here.step)
            step = min(limit, step) if here.step > best.step else max(limit, step)
        else:
            step = min(max(secant if near else cubic, low), high)
    elif bracketed:
        theta, gamma = _cubic(other, here, here.step > other.step)
        r = (gamma - here.slope + theta) / (gamma - here.slope + gamma + other.slope)
        step = here.step + r * (other.step - here.step)
    else:
        step = high if here.step > best.step else low
    return ends[0], ends[1], step, ends[2]


def _cubic(one: _At, here: _At, negative: bool) -> tuple[float, float]:
    """Terms theta and gamma of the cubic through two points with their slopes."""
    theta = 3.0 * (one.value - here.value) / (here.step - one.step) + one.slope + here.slope
    scale = max(abs(theta), abs(one.slope), abs(here.slope))
    inner = (theta / scale) ** 2 - one.slope / scale * (here.slope / scale)
    gamma = scale * math.sqrt(max(inner, 0.0))
    return theta, -gamma if negative else gamma
