"""States of modes, poses with their velocities: predicted, and corrected by where poses were found.

A mode's pose x and velocity v have one Gaussian. An image shows only x: when it has been found
at x* with the covariance P*, the prediction N((x, v), P) is conditioned on it,

    G = P_vx P_xx^-1,    v* = v + G (x* - x),    P*_vv = P_vv - G P_xv + G P* G',    P*_vx = G P*

which is the Kalman filter where the energy of the image is quadratic. Where a limb has jumped its
displacement is no motion: its velocity is then unknown. Its new place is as uncertain as after a
random walk at the rates of the body; jumps are searched within that range, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics

# Variance of a variable that may be anywhere, as it jumped, rad^2 or m^2: as good as infinite.
UNKNOWN_VARIANCE = 1e6


@dataclass(frozen=True, eq=False)
class PredictedStates:
    """States of K modes at the time of the next image.

    Attributes:
        dynamics: that predicted them.
        means: (K, n); the first d are the pose, which may lie beyond the limits of the body.
        covariances: (K, n, n).
        wandered: (d,) variances by which jumps may miss; zeros where the poses walk randomly, which
            leaves room enough.
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
        """Covariances (K, d, d) of the poses among which jumps are searched."""
        return self.pose_covariances + np.diag(self.wandered)

    def covariances_of(self, ancestors: Index, jumped: Mask) -> Array:
        """Covariances (N, d, d) of the motion prior of hypotheses; see `given`."""
        result = self.pose_covariances[ancestors]
        diagonal = np.arange(result.shape[1])
        result[:, diagonal, diagonal] += np.where(jumped, self.wandered, 0.0)
        return result

    def precisions_of(self, ancestors: Index, jumped: Mask, precisions: Array) -> Array:
        """Inverses (N, d, d) of `covariances_of`, given those of the modes (K, d, d)."""
        result = precisions[ancestors]
        rows = np.flatnonzero(jumped.any(1))
        if self.wandered.any() and len(rows):
            result[rows] = np.linalg.inv(self.covariances_of(ancestors[rows], jumped[rows]))
        return result

    def given(
        self, ancestors: Index, jumped: Mask, poses: Array, found: Array
    ) -> tuple[Array, Array]:
        """Velocities (N, d) and covariances (N, n, n) of states whose poses have been found.

        Args:
            ancestors: (N,) mode that each was predicted from.
            jumped: (N, d) degrees of freedom that did not move, but jumped.
            poses: (N, d) where the poses are.
            found: (N, d, d) their covariances.
        """
        d, n = self.dynamics.dimension, self.dynamics.state_dimension
        if n == d:
            return np.zeros_like(poses), found
        predicted = self.covariances[ancestors]
        known = predicted[:, :d, :d].copy()
        diagonal = np.arange(d)
        known[:, diagonal, diagonal] += np.where(jumped, UNKNOWN_VARIANCE, 0.0)
        cross = predicted[:, :d, d:]
        gain = np.linalg.solve(known, cross).swapaxes(1, 2)
        offset = poses - self.means[ancestors, :d]
        velocities = self.means[ancestors, d:] + np.einsum('nij,nj->ni', gain, offset)
        together = gain @ found
        own = predicted[:, d:, d:] - gain @ cross + together @ gain.swapaxes(1, 2)
        own = 0.5 * (own + own.swapaxes(1, 2))
        # An unknown velocity is correlated with no other.
        both = ~(jumped[:, :, None] | jumped[:, None, :])
        fresh = jumped[:, :, None] & jumped[:, None, :]
        own = np.where(both, own, np.where(fresh, self.dynamics.unknown_velocity, 0.0))
        together = np.where(jumped[:, :, None], 0.0, together)
        covariances = np.empty((len(poses), n, n))
        covariances[:, :d, :d], covariances[:, d:, d:] = found, own
        covariances[:, d:, :d] = together
        covariances[:, :d, d:] = together.swapaxes(1, 2)
        return np.where(jumped, 0.0, velocities), covariances


def fused(a: Array, b: Array) -> Array:
    """Covariances (N, d, d) of products of Gaussians of covariances (N, d, d) both."""
    result = a - a @ np.linalg.solve(a + b, a)
    return 0.5 * (result + result.swapaxes(1, 2))
