"""Estimate of a person's shape, that is lengths and flesh, over a track.

    S_k = H_tt - H_tp C_k H_pt,    g_k = h_t - H_tp C_k h_p,    C_k = H_pp^-1            at mode k
    J_k = -C_k H_pt                                                                 dx_k / dtheta
    A = sum tau S,    b = sum tau (S theta - g),    n = sum tau                over images and modes
    P = (P_0^-1 + A / (1 + c n))^-1,    theta = P b / (1 + c n)

theta is the shape (see `body.shape`), x_k the pose of mode k, and h and H are the gradient and the
Gauss-Newton Hessian of the energy of one image over shape and pose. The pose adapts to a wrong
shape, so the remaining information on the shape is the Schur complement S. Every image is weighted
by its share tau, because neighbouring images have the same errors. All images together are worth at
most 1 / c images (`inference.error_model`), because clothes and other unmodelled effects are the
same in all of them, and would finally outweigh the prior over people. Uncertainty of the shape
makes the pose uncertain: J P J' is added to the covariances of modes (a consider covariance,
[Schmidt 1966]).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.shape import ShapeSpace
from hmt_ros.core import RECORDED, consider_shape, inform_shape
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.inference.linear_algebra import product, solve
from hmt_ros.tracking.settings import (
    MAX_ANGLE_SHIFT,
    MAX_SHAPE_CHANGE,
    MAX_SHAPE_STEP,
    REBUILDING_CHANGE,
)


class Linearised(NamedTuple):
    """Second-order expansion of the energy of an image over shape and pose, at N poses.

    Attributes:
        by_shape: (N, P) gradient with respect to the shape.
        curvature: (N, P, P) Gauss-Newton Hessian over the shape.
        mixed: (N, P, d) block of the Gauss-Newton Hessian between shape and pose.
    """

    by_shape: Array
    curvature: Array
    mixed: Array


class ShapeEstimate:
    """Estimates the shape of one person.

    Args:
        body: initial estimate, whose `length_covariance` is the prior of the lengths.

    Attributes:
        covariance: (P, P) covariance of the shape.
    """

    def __init__(self, body: Body) -> None:
        self._space = ShapeSpace(body)
        self._spread, self._prior = self._space.prior
        self.covariance = self._prior
        size = self._space.size
        self._information, self._vector = np.zeros((size, size)), np.zeros(size)
        self._count = 0.0
        self._offset = np.zeros(size)
        # Shape offset of the present body, which follows the estimate in steps.
        self._taken = self._offset
        self._seen: Observation | None = None
        self._known: tuple[Array, Linearised] | None = None

    @property
    def body(self) -> Body:
        """Body with the estimated shape."""
        return self._space.body

    def update(
        self,
        likelihood: ImageLikelihood,
        observation: Observation,
        poses: Array,
        weights: Array,
        gradients: Array,
        covariances: Array,
        *,
        image_share: float,
    ) -> Body:
        """Updates the shape from an image; returns the person's body.

        Args:
            likelihood: likelihood of the present body.
            observation: observation of the image.
            poses, weights: poses (K, d) and weights (K,) of the modes in the image.
            gradients: (K, d) gradients of the energy of image and body prior, with respect to the
                pose.
            covariances: (K, d, d) inverse Hessians of the same energy, 0 for variables on a limit.
            image_share: share tau by which the image is weighted.
        """
        linear = self.linearised(likelihood, observation, poses)
        size, turns = self._space.size, self._space.body.skeleton.dof_is_rotation
        information, pull = np.empty((size, size)), np.empty(size)
        modes = (np.ascontiguousarray(x) for x in (weights, gradients, covariances))
        if not inform_shape(*linear, *modes, turns, MAX_ANGLE_SHIFT, information, pull):
            raise np.linalg.LinAlgError('the covariance of a mode is singular')
        self._information += image_share * information
        self._vector += image_share * (product(information, self._taken) - pull)
        self._count += image_share
        believed = ERRORS['shape'].together(self._count)
        spread = np.eye(size) + believed * product(self._prior, self._information)
        after = solve(spread, self._prior)
        self.covariance = 0.5 * (after + after.T)
        move = believed * product(self.covariance, self._vector) - self._offset
        furthest = np.abs(move / self._spread).max()
        move *= MAX_SHAPE_STEP / max(float(furthest), MAX_SHAPE_STEP)
        limit = MAX_SHAPE_CHANGE * self._spread
        self._offset = np.clip(self._offset + move, -limit, limit)
        ahead = self._offset - self._taken
        if np.abs(ahead / self._spread).max() > REBUILDING_CHANGE:
            self._space, self._taken = ShapeSpace(self._space.moved(ahead)), self._offset
            self._known = None
        return self._space.body

    def induced_covariances(
        self,
        likelihood: ImageLikelihood,
        observation: Observation,
        poses: Array,
        covariances: Array,
    ) -> Array:
        """Covariances J P J' (K, d, d) of modes due to the uncertain shape.

        See `update` for the arguments.
        """
        mixed = self.linearised(likelihood, observation, poses).mixed
        result = np.empty(covariances.shape)
        consider_shape(mixed, np.ascontiguousarray(covariances), self.covariance, result)
        return result

    def linearised(
        self, likelihood: ImageLikelihood, observation: Observation, poses: Array
    ) -> Linearised:
        """Expands the energy of an image's contours and keypoints around poses (N, d).

        The last result is cached, because the covariances of all modes need it, and then the shape,
        from the best modes.
        """
        n = len(poses)
        if self._seen is observation and self._known is not None:
            known, found = self._known
            if np.array_equal(known[:n], poses):
                return Linearised(*(x[:n] for x in found))
        frames = forward(self._space.body.skeleton, poses)
        of_joints = np.zeros((n, 1, RECORDED))
        if observation.keypoints is not None and likelihood.settings.keypoints.weight > 0:
            of_joints = likelihood.keypoint_term(observation, None).recorded(frames)
        of_flesh = likelihood.recorded(frames, observation)
        found = Linearised(*self._space.second_order(frames, of_flesh, of_joints))
        self._seen, self._known = observation, (poses, found)
        return found
