"""States of modes, that is poses and velocities: predicted, then conditioned on fitted poses.

A mode's pose x and velocity v have a joint Gaussian. An image shows only x: after a fit at x* with
the covariance P*, the prediction N((x, v), P) is conditioned on x*,

    G = P_vx P_xx^-1,    v* = v + G (x* - x),    P*_vv = P_vv - G P_xv + G P* G',    P*_vx = G P*

which is the Kalman filter if the energy of the image is quadratic. If a limb has jumped, its
displacement is not a motion, so its velocity is unknown. Its position is as uncertain as after a
random walk at the rates of the body, which is also the search range of jumps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_ros.core import correct_states, fuse, widen_precisions
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics

# Variance of the prediction of a jumped variable, practically infinite, rad^2 or m^2.
UNKNOWN_VARIANCE = 1e6


@dataclass(frozen=True, eq=False)
class PredictedStates:
    """States of K modes at the time of the next image.

    Attributes:
        dynamics: dynamics of the prediction.
        means: (K, n) means; the first d variables are the pose, possibly beyond the body's limits.
        covariances: (K, n, n) covariances of the states.
        wandered: (d,) additional variances for jumps; zero for random walks, whose variances
            suffice.
    """

    dynamics: LinearGaussianDynamics
    means: Array
    covariances: Array
    wandered: Array

    @property
    def poses(self) -> Array:
        """Means (K, d) of the poses."""
        return self.means[:, : self.dynamics.dimension]

    @property
    def pose_covariances(self) -> Array:
        """Covariances (K, d, d) of the poses."""
        d = self.dynamics.dimension
        return self.covariances[:, :d, :d]

    @property
    def searched(self) -> Array:
        """Covariances (K, d, d) of poses in which to search for jumps."""
        return self.pose_covariances + np.diag(self.wandered)

    def covariances_of(self, ancestors: Index, jumped: Mask) -> Array:
        """Covariances (N, d, d) of the motion prior of hypotheses; see `given`."""
        result = self.pose_covariances[ancestors]
        diagonal = np.arange(result.shape[1])
        result[:, diagonal, diagonal] += np.where(jumped, self.wandered, 0.0)
        return result

    def precisions_of(self, ancestors: Index, jumped: Mask, precisions: Array) -> Array:
        """Inverses (N, d, d) of `covariances_of`, given the precisions (K, d, d) of the modes."""
        result = np.empty((len(ancestors), *precisions.shape[1:]))
        widen_precisions(precisions, ancestors, jumped, self.wandered, result)
        return result

    def given(
        self, ancestors: Index, jumped: Mask, poses: Array, found: Array
    ) -> tuple[Array, Array]:
        """Condition states on poses; return velocities (N, d) and covariances (N, n, n).

        Args:
            ancestors: (N,) mode from which each state was predicted.
            jumped: (N, d) whether each degree of freedom jumped instead of moving.
            poses: (N, d) fitted poses.
            found: (N, d, d) covariances of the fitted poses.
        """
        (count, d), n = poses.shape, self.dynamics.state_dimension
        if n == d:
            return np.zeros_like(poses), found
        velocities, covariances = np.empty((count, d)), np.empty((count, n, n))
        predicted = Predicted(
            self.means, self.covariances, UNKNOWN_VARIANCE, self.dynamics.unknown_velocity
        )
        correct_states(predicted, ancestors, jumped, poses, found, velocities, covariances)
        return velocities, covariances


class Predicted(NamedTuple):
    """Predicted states with velocities, as input for the compiled functions.

    Attributes:
        means, covariances: means (K, 2 d) and covariances (K, 2 d, 2 d).
        unknown_variance: value of `UNKNOWN_VARIANCE`.
        unknown_velocity: (d, d) covariance of the velocity of jumped variables.
    """

    means: Array
    covariances: Array
    unknown_variance: float
    unknown_velocity: Array


def fused(a: Array, b: Array) -> Array:
    """Return covariances (N, d, d) of products of two Gaussians with covariances (N, d, d)."""
    result = np.empty(a.shape)
    fuse(np.ascontiguousarray(a), np.ascontiguousarray(b), result)
    return result
