"""Prior of trajectories in which points of the body rest on the ground.

Whether a point rests or moves is a Markov chain with the rate `CHANGE_RATE`. The evidence is the
speed of the point along a trajectory,

    rests: v_across ~ N(0, 0.07^2), v_away ~ N(0, 0.17^2)    moves: N(0, 0.7^2), N(0, 0.6^2)   m/s

across and along the most uncertain direction of a point, approximately the line of sight. Between
two images a point that rests with probability r has the cost

    r |p(x_{t+1}) - p(x_t)|^2 / (2 q dt)                      q: slip of a resting point, m^2/s

The difference is linear in the poses near a trajectory, so the cost is added to the trajectory's
prior (1) as a Gaussian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hmt_ros.body import Body
from hmt_ros.body.ground_terms import sole_jacobians, sole_points, soles
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.block_tridiagonal import BlockTridiagonal
from hmt_ros.inference.linear_algebra import product, symmetric_eigen
from hmt_ros.inference.linear_gaussian_dynamics import TrajectoryPrior

# Standard deviations of the speed across and along the most uncertain direction, of resting and of
# moving points in trajectories of the smoother, m/s; from the feet of the clips.
REST_SIGMAS, MOTION_SIGMAS = (0.07, 0.17), (0.7, 0.6)
# Rate at which a point changes between rest and motion, 1/s.
CHANGE_RATE = 2.0
# Variance of the slip of a resting point, m^2/s: 9 mm in a second.
SLIP_VARIANCE = 8e-5
# Minimum probability of rest of a constrained point.
MIN_REST_PROBABILITY = 1e-3


class RestingTable(NamedTuple):
    """R linearised coordinates of points that rest along a trajectory.

    Attributes:
        jacobians: (T, R, d) derivatives of the coordinates with respect to the poses.
        places: (T, R) linearised coordinates, extrapolated to the pose 0, m.
        weights: (T-1, R) weights r / (q dt) of the cost.
    """

    jacobians: Array
    places: Array
    weights: Array

    @classmethod
    def none(cls, times: int, d: int) -> RestingTable:
        """Return a table without resting points."""
        return cls(np.empty((times, 0, d)), np.empty((times, 0)), np.empty((times - 1, 0)))


@dataclass(frozen=True, eq=False)
class RestingPoints:
    """Points of the body that may rest on the ground, in a static frame.

    Attributes:
        points: maps poses (N, d) to points (N, P, 3), m.
        jacobians: maps poses (N, d) to the derivatives (N, P, 3, d) of the points.
    """

    points: Callable[[Array], Array]
    jacobians: Callable[[Array], Array]

    @classmethod
    def of_soles(cls, body: Body) -> RestingPoints | None:
        """Return heels and toes of a body, or None if it has no feet."""
        if not len(soles(body)):
            return None
        return cls(
            lambda poses: sole_points(body, poses), lambda poses: sole_jacobians(body, poses)
        )

    def along(self, poses: Array, covariances: Array, intervals: Array) -> RestingTable | None:
        """Return the resting points along a trajectory, or None if no point rests.

        Args:
            poses: (T, d) poses from which rest is estimated and at which points are linearised.
            covariances: (T, d, d) of the poses.
            intervals: (T-1,) s.
        """
        count, d = poses.shape
        points, jacobians = self.points(poses), self.jacobians(poses)
        rests = rest_probabilities(points, jacobians, covariances, intervals)
        if not (rests >= MIN_REST_PROBABILITY).any():
            return None
        weights = np.where(rests >= MIN_REST_PROBABILITY, rests, 0.0) / (
            SLIP_VARIANCE * intervals[:, None]
        )
        each = np.ascontiguousarray(jacobians.reshape(count, -1, d))
        places = points.reshape(count, -1) - product(each, poses[:, :, None])[:, :, 0]
        return RestingTable(each, places, np.repeat(weights, 3, axis=1))

    def constrained_prior(
        self, prior: TrajectoryPrior, poses: Array, covariances: Array, intervals: Array
    ) -> TrajectoryPrior:
        """Add the resting points of a trajectory (T, d) to the prior of trajectories near it.

        Args:
            prior: prior of the states, whose first d variables are the pose.
            poses, covariances, intervals: see `along`.
        """
        found, d = self.along(poses, covariances, intervals), poses.shape[1]
        if found is None:
            return prior
        weights = found.weights[:, :, None]
        before, after = found.jacobians[:-1], found.jacobians[1:]
        # p(x_{t+1}) - p(x_t) as a linear function of both poses.
        rest = weights * np.diff(found.places, axis=0)[:, :, None]
        diagonal, lower = prior.precision.diagonal.copy(), prior.precision.lower.copy()
        information = prior.information.copy()
        diagonal[:-1, :d, :d] += product(before.swapaxes(1, 2), weights * before)
        diagonal[1:, :d, :d] += product(after.swapaxes(1, 2), weights * after)
        lower[:, :d, :d] -= product(after.swapaxes(1, 2), weights * before)
        information[:-1, :d] += product(before.swapaxes(1, 2), rest)[:, :, 0]
        information[1:, :d] -= product(after.swapaxes(1, 2), rest)[:, :, 0]
        return replace(prior, precision=BlockTridiagonal(diagonal, lower), information=information)


def rest_probabilities(
    points: Array, jacobians: Array, covariances: Array, intervals: Array
) -> Array:
    """Probabilities (T-1, P) that a point rests from one pose of a trajectory to the next.

    Args:
        points, jacobians: points (T, P, 3) and their derivatives (T, P, 3, d) with respect to the
            poses.
        covariances: (T, d, d); only the most uncertain direction of each point is used.
        intervals: (T-1,) s.
    """
    spread = product(product(jacobians, covariances[:, None]), jacobians.swapaxes(2, 3))
    least_known = symmetric_eigen(spread[1:])[1][..., -1]
    velocities = np.diff(points, axis=0) / intervals[:, None, None]
    away = np.einsum('tpi,tpi->tp', velocities, least_known)
    across = np.linalg.norm(velocities - away[:, :, None] * least_known, axis=2)
    log = np.stack([_log_density(across, away, sigmas) for sigmas in (REST_SIGMAS, MOTION_SIGMAS)])
    changes = 0.5 * -elementary.expm1(-2.0 * CHANGE_RATE * intervals)
    return np.asarray(_smoothed_chain(elementary.exp(log - log.max(0)), changes)[0])


def _log_density(across: Array, away: Array, sigmas: tuple[float, float]) -> Array:
    """Log density of speeds across and along a direction, up to a constant."""
    wide, deep = sigmas
    return np.asarray(
        -2.0 * elementary.log(wide)
        - elementary.log(deep)
        - 0.5 * ((across / wide) ** 2 + (away / deep) ** 2)
    )


def _smoothed_chain(likelihoods: Array, changes: Array) -> Array:
    """Probabilities (2, T, P) of the states of P chains with two states, given all T times.

    Args:
        likelihoods: (2, T, P).
        changes: (T,) probability that a chain changes its state before each time.
    """
    forwards, backwards = likelihoods.copy(), np.ones_like(likelihoods)
    times = likelihoods.shape[1]
    for t in range(times):
        if t > 0:
            before = forwards[:, t - 1]
            forwards[:, t] *= before + changes[t] * (before[::-1] - before)
        forwards[:, t] /= forwards[:, t].sum(0)
    for t in range(times - 2, -1, -1):
        after = likelihoods[:, t + 1] * backwards[:, t + 1]
        backwards[:, t] = after + changes[t + 1] * (after[::-1] - after)
        backwards[:, t] /= backwards[:, t].sum(0)
    both = forwards * backwards
    return np.asarray(both / both.sum(0))
