"""Trajectories of locally maximal posterior density (VMS 5, with its equation numbers).

    E(X) = -log p(x_1) - sum_t log p(x_t | x_{t-1}) - sum_t log p(r_t | x_t)       -log of (1)

is minimised from many starts by damped Newton steps D on the block-tridiagonal system,

    minimise    g.D + 1/2 D.(H + lambda W) D    subject to    lower <= x_t <= upper       (5)

where `TrustRegion` adapts lambda. The Hessian of an observation is indefinite between modes. If the
matrix can not be factorised, it is blended with the positive part of the curvature; if the
resulting step does not descend either, the damping grows. A variable at a limit is fixed if the
descent would move it outwards; a step that crosses limits is projected onto the box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.core import add_band_product, add_diagonal, hold
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.block_tridiagonal import (
    BlockCholesky,
    NotPositiveDefiniteError,
    factorise,
)
from hmt_ros.inference.bounded_newton import Status, TrustRegion, resting
from hmt_ros.inference.energy import Derivatives
from hmt_ros.inference.linear_gaussian_dynamics import TrajectoryPrior
from hmt_ros.smoothing.likelihood import SequenceLikelihood

FIRST_DAMPING = 1e-4
DAMPING_LIMIT = 1e10
# Shares of the positive Hessian in a blend with an indefinite exact Hessian.
HESSIAN_SHARES = (0.125, 0.25, 0.5, 0.75)
# Maximum number of values in the observation Hessians that are in memory at a time.
HESSIAN_BUDGET = 800_000


@dataclass(frozen=True, eq=False)
class RefinedTrajectories:
    """Optima of the energy of trajectories, one for each start.

    Attributes:
        states: (M, T, n) states at the optima.
        energies: (M,) energies E, nats.
        observation_energies: (M,) the observations' part of E, - sum log p(r_t | x_t), nats.
        free: (M, T, n) whether each variable is free, not fixed at a limit.
        status: (M,) values of `Status`.
        iterations: (M,) number of evaluations after the first.
        factors: M Cholesky factors of the precision at the optimum. A variable fixed at a limit
            with slope g gets the extra precision g^2, because exp(-g distance) has variance 1/g^2.
        starts: (M,) index of the initial trajectory of each optimum.
    """

    states: Array
    energies: Array
    observation_energies: Array
    free: NDArray[np.bool_]
    status: NDArray[np.int8]
    iterations: NDArray[np.int32]
    factors: tuple[BlockCholesky, ...]
    starts: Index

    def __len__(self) -> int:
        return len(self.energies)

    def __getitem__(self, index: Index) -> RefinedTrajectories:
        """Select optima, in the order of the index."""
        return RefinedTrajectories(
            self.states[index],
            self.energies[index],
            self.observation_energies[index],
            self.free[index],
            self.status[index],
            self.iterations[index],
            tuple(self.factors[i] for i in index),
            self.starts[index],
        )

    def without_duplicates(self, distance: float = 0.1) -> RefinedTrajectories:
        """Return distinct optima, the most probable first.

        Two optima are the same if they differ by less than `distance` both in energy, in nats, and
        in states, in standard deviations of the more probable optimum.
        """
        order = np.argsort(self.energies, kind='stable')
        kept: list[int] = []
        for i in order:
            same = False
            for j in reversed(kept):
                if self.energies[i] - self.energies[j] > distance:
                    break
                offset = self.factors[j].whiten(self.states[i] - self.states[j])
                if (offset * offset).sum() < distance**2:
                    same = True
                    break
            if not same:
                kept.append(int(i))
        return self[np.array(kept, dtype=np.intp)]


def refine(
    starts: Array,
    prior: TrajectoryPrior,
    likelihood: SequenceLikelihood,
    lower: ArrayLike = -np.inf,
    upper: ArrayLike = np.inf,
    *,
    max_iterations: int = 60,
    tolerance: float = 1e-6,
) -> RefinedTrajectories:
    """Minimise the energy from M starts.

    Args:
        starts: (M, T, n) initial trajectories; they are projected onto the box.
        prior: prior of the states.
        likelihood: likelihood of the first d variables of each state.
        lower, upper: (d,) limits at every time, or scalars.
        max_iterations: maximum number of evaluations per trajectory after the first one.
        tolerance: predicted gain of a step below which a trajectory has converged, nats.
    """
    starts = np.asarray(starts, dtype=np.float64)
    _, times, n = starts.shape
    share = max(1, HESSIAN_BUDGET // (times * n * n))
    parts = []
    for at in range(0, len(starts), share):
        problem = _Problem(prior, likelihood, starts[at : at + share], lower, upper)
        problem.minimise(max_iterations, tolerance)
        parts.append(problem.result(at))
    return RefinedTrajectories(
        np.concatenate([part.states for part in parts]),
        np.concatenate([part.energies for part in parts]),
        np.concatenate([part.observation_energies for part in parts]),
        np.concatenate([part.free for part in parts]),
        np.concatenate([part.status for part in parts]),
        np.concatenate([part.iterations for part in parts]),
        tuple(factor for part in parts for factor in part.factors),
        np.concatenate([part.starts for part in parts]),
    )


class _Problem:
    """Joint minimisation of several trajectories, with their states and step controls."""

    def __init__(
        self,
        prior: TrajectoryPrior,
        likelihood: SequenceLikelihood,
        starts: Array,
        lower: ArrayLike,
        upper: ArrayLike,
    ) -> None:
        count, self.times, self.size = starts.shape
        self.prior, self.likelihood = prior, likelihood
        self.low, self.high = limits_of_states(lower, upper, prior.dimension, self.size)
        self.band = prior.precision.band()
        self.region = TrustRegion(
            count, FIRST_DAMPING, limit=DAMPING_LIMIT, least_factor=0.1, least_refused=FIRST_DAMPING
        )
        self.exact = np.ones(count, dtype=bool)
        self.status = np.full(count, Status.ITERATION_LIMIT, dtype=np.int8)
        self.iterations = np.zeros(count, dtype=np.int32)
        self.states = np.clip(starts, self.low, self.high)
        self.energy, self.observed, self.gradient, self.hessian = self._evaluate(
            self.states, Derivatives.EXACT
        )
        self.status[~np.isfinite(self.energy)] = Status.NOT_FINITE

    def minimise(self, max_iterations: int, tolerance: float) -> None:
        """Iterate until every trajectory has converged, stalled or reached its iteration limit."""
        active = np.flatnonzero(self.status == Status.ITERATION_LIMIT)
        for _ in range(max_iterations + 1):
            step, predicted = self._steps(active)
            done = predicted < tolerance
            self.status[active[done]] = Status.CONVERGED
            active, step, predicted = active[~done], step[~done], predicted[~done]
            over = self.iterations[active] >= max_iterations
            active, step, predicted = active[~over], step[~over], predicted[~over]
            if len(active) == 0:
                break
            trial = np.clip(self.states[active] + step, self.low, self.high)
            found = self._evaluate(trial, Derivatives.EXACT)
            self.iterations[active] += 1
            better = self.region.accept(active, self.energy[active] - found[0], predicted)
            rows = active[better]
            self.states[rows] = trial[better]
            for name, value in zip(('energy', 'observed', 'gradient', 'hessian'), found):
                getattr(self, name)[rows] = value[better]
            # After a refused step, first use the positive part of the curvature, then increase the
            # damping.
            refused = active[~better]
            damped = refused[~self.exact[refused]]
            self.exact[rows], self.exact[refused] = True, False
            self.status[self.region.refuse(damped)] = Status.STALLED
            active = active[self.status[active] == Status.ITERATION_LIMIT]

    def result(self, offset: int) -> RefinedTrajectories:
        """Return the optima; `offset` is the index of the first start."""
        everyone = np.arange(len(self.states))
        held = resting(self.states, self.gradient, self.low, self.high)
        # The density is 0 beyond a limit and decreases with distance from the limit as exp(-g
        # distance).
        slope = np.where(held, self.gradient, 0.0) ** 2
        factors = [self._factor(self.hessian[i], slope[i]) for i in everyone]
        failed = np.array([i for i in everyone if factors[i] is None], dtype=np.intp)
        if len(failed):
            positive = self._evaluate(self.states[failed], Derivatives.POSITIVE)[3]
            for i, hessian in zip(failed, positive):
                factors[i] = self._positive_factor(hessian, slope[i])
        return RefinedTrajectories(
            self.states,
            self.energy,
            self.observed,
            ~held,
            self.status,
            self.iterations,
            tuple(factor for factor in factors if factor is not None),
            everyone + offset,
        )

    def _evaluate(
        self, states: Array, derivatives: Derivatives
    ) -> tuple[Array, Array, Array, Array]:
        """Return energies, observation energies, gradients (M, T, n) and Hessians (M, T, d, d)."""
        m, d = len(states), self.prior.dimension
        at = np.tile(np.arange(self.times), m)
        poses = states[:, :, :d].reshape(-1, d)
        found = self.likelihood.energy(poses, at, derivatives=derivatives)
        slope, hessian = found.derivatives()
        observed = found.value.reshape(m, self.times).sum(1)
        energy = observed + self.prior.constant
        flat, information = states.reshape(m, -1), self.prior.information.reshape(-1)
        gradient = np.zeros((m, self.times, self.size))
        moved = gradient.reshape(m, -1)
        add_band_product(self.band, flat, moved)
        energy += (flat * (0.5 * moved - information)).sum(1)
        moved -= information
        gradient[:, :, :d] += slope.reshape(m, self.times, d)
        return energy, observed, gradient, hessian.reshape(m, self.times, d, d)

    def _steps(self, active: Index) -> tuple[Array, Array]:
        """Return damped steps (M, T, n), projected onto the box, and their predicted decreases."""
        step = np.zeros((len(active), self.times, self.size))
        predicted = np.zeros(len(active))
        held = resting(self.states[active], self.gradient[active], self.low, self.high)
        failed = []
        for row, i in enumerate(active):
            if not self.exact[i] or not self._step(i, self.hessian[i], held[row], step[row]):
                failed.append(row)
        if failed:
            positive = self._evaluate(self.states[active[failed]], Derivatives.POSITIVE)[3]
            for row, hessian in zip(failed, positive):
                i = active[row]
                # Blend an indefinite Hessian with the smallest share of the positive Hessian that
                # makes the blend positive definite.
                if self.exact[i] and any(
                    self._step(
                        i,
                        (1.0 - share) * self.hessian[i] + share * hessian,
                        held[row],
                        step[row],
                    )
                    for share in HESSIAN_SHARES
                ):
                    continue
                self.exact[i] = False
                while not self._step(i, hessian, held[row], step[row]):
                    self.region.damping[i] *= 4.0
        for row, i in enumerate(active):
            move = np.clip(self.states[i] + step[row], self.low, self.high) - self.states[i]
            slope = float((self.gradient[i] * move).sum())
            damping = self.region.damping[i] * float(
                (move * move * self._metric(self.hessian[i])).sum()
            )
            predicted[row] = -0.5 * slope + 0.5 * damping if slope < 0 else 0.0
            step[row] = move
        return step, predicted

    def _step(self, i: int, hessian: Array, held: NDArray[np.bool_], step: Array) -> bool:
        """Compute the step of a trajectory; return False if the matrix is not positive definite."""
        extra = self.region.damping[i] * self._metric(hessian)
        factor = self._factor(hessian, extra, held)
        if factor is None:
            return False
        right = np.where(held, 0.0, -self.gradient[i])
        step[:] = factor.solve(right)
        return True

    def _metric(self, hessian: Array) -> Array:
        """Return the diagonal (T, n) of the metric of steps."""
        d = self.prior.dimension
        metric = np.diagonal(self.prior.precision.diagonal, axis1=1, axis2=2).copy()
        metric[:, :d] += np.maximum(np.diagonal(hessian, axis1=1, axis2=2), 0.0)
        return metric

    def _factor(
        self, hessian: Array, extra: Array, held: NDArray[np.bool_] | None = None
    ) -> BlockCholesky | None:
        """Factorise prior precision + Hessians (T, d, d) + diagonal (T, n); None if indefinite."""
        columns = self.band.copy()
        add_diagonal(columns, np.ascontiguousarray(hessian), self.size)
        columns[:, 0] += extra.reshape(-1)
        if held is not None:
            hold(columns, np.flatnonzero(held))
        try:
            return factorise(columns, self.times, self.size)
        except NotPositiveDefiniteError:
            return None

    def _positive_factor(self, hessian: Array, extra: Array) -> BlockCholesky:
        """Factorise the same matrix as `_factor`, shifted until it is positive definite."""
        shift = 0.0
        while True:
            factor = self._factor(hessian, extra + shift * self._metric(hessian))
            if factor is not None:
                return factor
            shift = max(4.0 * shift, 1e-9)


def limits_of_states(
    lower: ArrayLike, upper: ArrayLike, dimension: int, size: int
) -> tuple[Array, Array]:
    """Extend limits (d,) of poses to limits (n,) of states, in which velocities are unlimited.

    Raises:
        ValueError: limits have the wrong dimension, or a lower limit exceeds the upper limit.
    """
    low, high = np.full((2, size), [[-np.inf], [np.inf]])
    for name, limits, given in (('lower', low, lower), ('upper', high, upper)):
        value = np.asarray(given, dtype=np.float64)
        if value.shape not in ((), (dimension,)):
            raise ValueError(f'{name} limits have shape {value.shape}, wanted ({dimension},)')
        limits[:dimension] = value
    if not (low <= high).all():
        i = int(np.argmin(low <= high))
        raise ValueError(f'limits of variable {i}: lower {low[i]} is above upper {high[i]}')
    return low, high
