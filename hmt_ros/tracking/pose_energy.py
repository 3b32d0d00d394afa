"""What poses cost: the image, the body, and the way from where they were expected (KJS 2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.likelihood import ImageLikelihood, TermSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.texture import Textures
from hmt_ros.inference.bounded_newton import Minimum, minimise
from hmt_ros.tracking.tracker_settings import TrackerSettings

Array = NDArray[np.float64]
Index = NDArray[np.intp]
# Value, gradient and Hessian at poses, of which an index says whose turn it is.
Energy = Callable[[Array, Index], tuple[Array, Array, Array]]

# Newton steps that follow the optical flow.
MOTION_ITERATIONS = 5


class PoseEnergy:
    """Energies of poses of one body before one camera, and their minima.

    Args:
        body, camera: who is seen by what.
        settings: of the tracker.

    Attributes:
        evaluations: of the likelihood, so far.
    """

    def __init__(self, body: Body, camera: Camera, settings: TrackerSettings) -> None:
        self.body, self.camera, self.settings = body, camera, settings
        self.evaluations = 0
        self._step_scale = np.where(body.skeleton.dof_is_rotation, 0.3, 0.2)

    @cached_property
    def likelihood(self) -> ImageLikelihood:
        """Of images."""
        return ImageLikelihood(self.body, self.camera, self.settings.likelihood)

    def count(self, evaluations: int) -> None:
        """Adds evaluations that were made elsewhere."""
        self.evaluations += evaluations

    def values(
        self, poses: Array, observation: Observation, textures: Textures | None, which: Index
    ) -> Array:
        """Energies (N,) of poses (N, d) without what was expected.

        Args:
            poses: (N, d).
            observation: of the image.
            textures: of the last image.
            which: (N,) row of the textures of each.
        """
        self.evaluations += len(poses)
        frames = forward(self.body.skeleton, poses)
        image = self.likelihood.image_energy(
            frames, observation, textures, which, derivatives=False
        )
        soft, overlap = self.likelihood.prior(poses)[0], self.likelihood.intersection(frames)[0]
        return image.value + soft + overlap

    def around(self, observation: Observation, centres: Array, precisions: Array) -> Energy:
        """With Gaussians of precisions (N, d, d) around centres (N, d), without textures."""

        def energy(x: Array, index: Index) -> tuple[Array, Array, Array]:
            self.evaluations += len(x)
            value, gradient, hessian = self.likelihood.energy(x, observation, None, None)
            offset = x - centres[index]
            pulled = np.einsum('nij,nj->ni', precisions[index], offset)
            return (
                value + 0.5 * (offset * pulled).sum(1),
                gradient + pulled,
                hessian + precisions[index],
            )

        return energy

    def alone(self, observation: Observation) -> Energy:
        """Of the image and the body alone."""

        def energy(x: Array, _: Index) -> tuple[Array, Array, Array]:
            self.evaluations += len(x)
            return self.likelihood.energy(x, observation, None, None)

        return energy

    def posterior(
        self,
        observation: Observation,
        parents: Index,
        centres: Array,
        precisions: Array,
        textures: Textures | None,
        texture_rows: Index,
    ) -> Energy:
        """With a Student prior around where each pose is expected.

        Args:
            observation: of the image.
            parents: (N,) whose precision each has.
            centres: (N, d) where each is expected.
            precisions: (K, d, d).
            textures: of the last image.
            texture_rows: (N,) row of the textures of each.
        """
        nu, d = self.settings.tails, self.body.dimension

        def energy(x: Array, index: Index) -> tuple[Array, Array, Array]:
            own = parents[index]
            self.evaluations += len(x)
            value, gradient, hessian = self.likelihood.energy(
                x, observation, textures, texture_rows[index]
            )
            offset = x - centres[index]
            pulled = np.einsum('nij,nj->ni', precisions[own], offset)
            distance = (offset * pulled).sum(1)
            shrink = (nu + d) / (nu + distance)
            value = value + 0.5 * (nu + d) * np.log1p(distance / nu)
            gradient += shrink[:, None] * pulled
            hessian += shrink[:, None, None] * precisions[own]
            return value, gradient, hessian

        return energy

    def student_shrinkage(self, offset: Array, precisions: Array) -> Array:
        """Curvature (N,) of the Student prior over that of the Gaussian with its covariance."""
        nu, d = self.settings.tails, self.body.dimension
        distance = np.einsum('ni,nij,nj->n', offset, precisions, offset)
        return np.asarray((nu + d) / (nu + distance), dtype=np.float64)

    def minimise(self, energy: Energy, poses: Array, iterations: int) -> Minimum:
        """Minima from poses (N, d) within the limits of the body."""
        return minimise(
            energy, poses, self.body.lower, self.body.upper, step_scale=self._step_scale,
            damping=1.0, max_iterations=iterations, tolerance=0.02,
        )  # fmt: skip

    def follow_motion(
        self,
        predicted: Array,
        precisions: Array,
        observation: Observation,
        textures: Textures | None,
    ) -> Array:
        """Predictions (K, d) corrected by the optical flow, before shapes are compared."""
        if observation.flow is None or self.settings.likelihood.motion.weight == 0:
            return predicted
        everyone = np.arange(len(predicted))

        def energy(x: Array, index: Index) -> tuple[Array, Array, Array]:
            image = self._motion_likelihood.image_energy(
                forward(self.body.skeleton, x), observation, textures, everyone[index]
            )
            assert image.gradient is not None
            assert image.hessian is not None
            offset = x - predicted[index]
            pulled = np.einsum('nij,nj->ni', precisions[index], offset)
            soft = self.likelihood.prior(x)
            return (
                image.value + soft[0] + 0.5 * (offset * pulled).sum(1),
                image.gradient + soft[1] + pulled,
                image.hessian + soft[2] + precisions[index],
            )

        return self.minimise(energy, predicted, MOTION_ITERATIONS).x

    @cached_property
    def _motion_likelihood(self) -> ImageLikelihood:
        off = TermSettings(0.0, 1.0, 1.0)
        only_motion = replace(
            self.settings.likelihood,
            joints=off, containment=off, coverage=off, edges=off, intensity=off,
        )  # fmt: skip
        return ImageLikelihood(self.body, self.camera, only_motion)
