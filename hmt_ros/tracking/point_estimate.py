"""The point estimate: the pose of the motion which faces the likelier way.

    z = sum_k w_k x_k,    R = sum_k w_k R_k        over the modes that face as the motion does  (1)
    (x, v) ~ N(A (x, v), A P A' + Q)                                                            (2)
    (x, v) <- (x, v) + G (z - x),    G = P_.x (P_xx + R)^-1                                     (3)

The modes of an image that face alike go on as one motion: a Gaussian over pose and velocity, moved
by the dynamics of the tracker (2) and conditioned on the mean of the image's modes (3). R_k are the
covariances of the modes, which believe only a share of an image, because errors last: how far the
pose follows an image depends on the information in the image, and on the time since the last one.
Differences between the modes are not in R: their weights know all images, not this one alone.

A mean over poses that face opposite ways is no pose. The motion keeps its way as long as the weight
of the other one is within the error of a single image, and then turns at once.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import left_directions, propagated, root_rotation_dofs
from hmt_ros.core import condition
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.settings import FACING_VALID


class PointEstimate:
    """The point estimate of a track.

    Attributes:
        pose: (d,); None: there is none yet.
    """

    def __init__(self) -> None:
        self.pose: Array | None = None
        # (n,) and (n, n): the motion, n = d where poses have no velocities, else 2 d.
        self._mean = self._covariance = np.empty(0)
        # (d,) the heaviest mode of the motion in its last image, which gives its facing way: the
        # mean of modes that are seen from the side may face between two ways.
        self._leader = np.empty(0)

    def carry(self, body: Body, motion: CameraMotion) -> None:
        """Takes the motion into the camera frame of the next image."""
        if self.pose is None:
            return
        d = body.dimension
        before = self._mean[None, :d]
        self.pose = motion.poses(body, before)[0]
        self._leader = motion.poses(body, self._leader[None])[0]
        turned = motion.jacobians(body, before, self.pose[None])
        whole = np.kron(np.eye(len(self._mean) // d), turned[0])
        self._mean = np.concatenate([self.pose, product(whole, self._mean)[d:]])
        self._covariance = propagated(whole[None], self._covariance[None])[0]

    def expect(self, body: Body, dynamics: LinearGaussianDynamics, dt: float) -> None:
        """Predicts the pose dt seconds after the last image, without another image."""
        moved, _ = self._predicted(dynamics, dt)
        self.pose = np.clip(moved[: body.dimension], body.lower, body.upper)

    def update(
        self,
        body: Body,
        dynamics: LinearGaussianDynamics,
        posterior: GaussianMixture,
        dt: float | None,
    ) -> None:
        """Takes in the posterior of an image.

        Args:
            body: of the poses.
            dynamics: of the poses.
            posterior: over the poses.
            dt: time since the image before, s; None: the modes begin with this image.
        """
        turns, own = self._choose_way(body, posterior, begins=dt is None)
        found, uncertain = _moments(body, posterior, own, self._leader)
        if dt is None or turns:
            at_rest = dynamics.initial_mean[body.dimension :]
            self._mean = np.concatenate([found, at_rest])
            self._covariance = dynamics.states(uncertain[None])[0]
        else:
            self._condition(body, *self._predicted(dynamics, dt), found, uncertain)
        self.pose = self._mean[: body.dimension].copy()

    def _choose_way(
        self, body: Body, posterior: GaussianMixture, *, begins: bool
    ) -> tuple[bool, Index]:
        """Takes the mode that leads from now on.

        Returns:
            Whether it faces another way than before, and the modes that face as it does.
        """
        weights, means = posterior.weights, posterior.means
        alike = np.ones((len(weights), len(weights) + 1), dtype=np.bool_)
        if body.trunk_pairs:
            poses = means if begins else np.concatenate([means, self._leader[None]])
            left = left_directions(body, poses)
            # Turned by at most 90 degrees from each other.
            alike[:, : len(poses)] = product(left[: len(weights)], left.T) >= 0
        as_before = alike[:, -1]
        turns = not as_before.any() or bool(
            weights[~as_before].sum() > FACING_VALID * weights.sum()
        )
        leads = int(np.argmax(np.where(as_before != turns, weights, -1.0)))
        self._leader = means[leads]
        return turns, np.flatnonzero(alike[:, leads])

    def _predicted(self, dynamics: LinearGaussianDynamics, dt: float) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) of the motion after dt seconds."""
        means, covariances = dynamics.predict(self._mean[None], self._covariance[None], dt)
        return means[0], covariances[0]

    def _condition(
        self, body: Body, mean: Array, covariance: Array, found: Array, uncertain: Array
    ) -> None:
        """Conditions a prediction on a pose (d,) that was found, of a covariance (d, d)."""
        d = body.dimension
        offset = _differences(body, found[None], mean[:d])[0]
        moved, left = np.empty_like(mean), np.empty_like(covariance)
        condition(mean, covariance, offset, uncertain, moved, left)
        # The root counts its turns as the modes do.
        moved[:d] += found - mean[:d] - offset
        moved[:d] = np.clip(moved[:d], body.lower, body.upper)
        self._mean, self._covariance = moved, left


def _moments(
    body: Body, posterior: GaussianMixture, own: Index, leader: Array
) -> tuple[Array, Array]:
    """Mean (d,) and covariance (d, d), as in (1), of the modes that face as one of them does."""
    weights, covariances = posterior.weights[own], posterior.covariances[own]
    weights = weights / weights.sum()
    mean = leader + product(weights, _differences(body, posterior.means[own], leader))
    covariance = product(weights, covariances.reshape(len(own), -1))
    return np.clip(mean, body.lower, body.upper), covariance.reshape(covariances.shape[1:])


def _differences(body: Body, poses: Array, reference: Array) -> Array:
    """Poses (N, d) minus a reference pose (d,), rotations of the root the short way round."""
    result = poses - reference
    root = root_rotation_dofs(body.skeleton)
    result[:, root] = (result[:, root] + np.pi) % (2.0 * np.pi) - np.pi
    return result
