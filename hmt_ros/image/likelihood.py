"""Negative log-likelihood of an image, and the soft prior of the body, for a batch of poses (KJS 2)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.self_intersection import self_intersection_energy
from hmt_ros.image.edge_term import edge_energy
from hmt_ros.image.intensity_term import intensity_energy, motion_energy
from hmt_ros.image.joint_term import joint_energy
from hmt_ros.image.observation import Observation
from hmt_ros.image.residuals import Energy, assemble_energies
from hmt_ros.image.silhouette_term import containment_energy, coverage_energy
from hmt_ros.image.surface import project_surface
from hmt_ros.image.texture import Textures

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True)
class TermSettings:
    """One term of the likelihood.

    Attributes:
        weight: how many independent measurements the term counts for; 0 switches it off. For joints:
            a factor.
        sigma: standard deviation of one measurement, px.
        scale: of the Geman-McClure kernel, in sigmas.
    """

    weight: float
    sigma: float
    scale: float

    def __post_init__(self) -> None:
        if not (self.weight >= 0 and self.sigma > 0 and self.scale > 0):
            raise ValueError(f'a term needs weight >= 0, sigma > 0 and scale > 0, saw {self}')


@dataclass(frozen=True)
class LikelihoodSettings:
    """The terms of the likelihood and of the prior.

    Attributes:
        joints: keypoints; sigma multiplies their own standard deviations.
        containment: the model's contour lies inside the silhouette.
        coverage: the silhouette's outline lies on the model's contour.
        edges: visible contours lie on edges.
        intensity: the texture of the last image is found again; sigma in grey levels.
        motion: the texture moves with the optical flow.
        prior_weight: factor on the soft prior of the joint angles.
        self_intersection_sigma: overlap of body parts that costs 1/2, m; inf switches it off.
    """

    joints: TermSettings = field(default=TermSettings(1.0, 1.0, 5.0))
    containment: TermSettings = field(default=TermSettings(30.0, 3.0, 8.0))
    coverage: TermSettings = field(default=TermSettings(30.0, 3.0, 8.0))
    edges: TermSettings = field(default=TermSettings(20.0, 2.5, 3.0))
    intensity: TermSettings = field(default=TermSettings(15.0, 20.0, 3.0))
    motion: TermSettings = field(default=TermSettings(20.0, 1.5, 4.0))
    prior_weight: float = 1.0
    self_intersection_sigma: float = 0.03


@dataclass(frozen=True, eq=False)
class ImageLikelihood:
    """-log p(image | pose) - log prior(pose) of a body before a camera."""

    body: Body
    camera: Camera
    settings: LikelihoodSettings = field(default_factory=LikelihoodSettings)

    def energy(
        self,
        poses: Array,
        observation: Observation,
        textures: Textures | None = None,
        which: Index | None = None,
    ) -> tuple[Array, Array, Array]:
        """Value (N,), gradient (N, d) and Gauss-Newton Hessian (N, d, d) at poses (N, d).

        Args:
            poses: (N, d).
            observation: of the image.
            textures: of the last image, for the terms of intensity and motion.
            which: (N,) the texture that each pose carries.
        """
        frames = forward(self.body.skeleton, poses)
        terms = self.terms(frames, observation, textures, which)
        value, gradient, hessian = assemble_energies(frames, list(terms.values()))
        for part in (self.prior(poses), self.intersection(frames)):
            value += part[0]
            gradient += part[1]
            hessian += part[2]
        return value, gradient, hessian

    def terms(
        self,
        frames: Frames,
        observation: Observation,
        textures: Textures | None = None,
        which: Index | None = None,
    ) -> dict[str, Energy]:
        """The terms that the observation and the settings allow, by name."""
        s = self.settings
        result: dict[str, Energy] = {}
        if observation.keypoints is not None and s.joints.weight > 0:
            result['joints'] = joint_energy(
                frames, self.camera, observation.keypoints,
                scale=s.joints.scale, weight=s.joints.weight / s.joints.sigma**2,
            )  # fmt: skip
        if textures is not None and which is not None:
            result |= self._texture_terms(frames, observation, textures, which)
        silhouette = observation.distance is not None
        wanted = silhouette and (s.containment.weight > 0 or s.coverage.weight > 0)
        if not wanted and (observation.edges is None or s.edges.weight == 0):
            return result
        surface = project_surface(self.body, self.camera, frames)
        if observation.distance is not None and s.containment.weight > 0:
            t = s.containment
            result['containment'] = containment_energy(
                surface, observation.distance, sigma=t.sigma, scale=t.scale, weight=t.weight
            )
        if observation.outline is not None and s.coverage.weight > 0:
            t = s.coverage
            result['coverage'] = coverage_energy(
                surface, observation.outline, sigma=t.sigma, scale=t.scale, weight=t.weight
            )
        if observation.edges is not None and s.edges.weight > 0:
            t = s.edges
            result['edges'] = edge_energy(
                surface, observation.edges, sigma=t.sigma, scale=t.scale, weight=t.weight
            )
        return result

    def _texture_terms(
        self, frames: Frames, observation: Observation, textures: Textures, which: Index
    ) -> dict[str, Energy]:
        result: dict[str, Energy] = {}
        t = self.settings.intensity
        if observation.intensity is not None and t.weight > 0:
            result['intensity'] = intensity_energy(
                frames, self.camera, textures, which, observation.intensity,
                sigma=t.sigma, scale=t.scale, weight=t.weight,
            )  # fmt: skip
        t = self.settings.motion
        if observation.flow is not None and t.weight > 0:
            result['motion'] = motion_energy(
                frames, self.camera, textures, which, observation.flow,
                sigma=t.sigma, scale=t.scale, weight=t.weight,
            )  # fmt: skip
        return result

    def prior(self, poses: Array) -> tuple[Array, Array, Array]:
        """Energy, gradient and Hessian of the soft prior of the joint angles."""
        body = self.body
        sigma = np.where(np.isfinite(body.prior_sigma), body.prior_sigma, np.inf)
        precision = self.settings.prior_weight * sigma**-2.0
        offset = poses - body.prior_mean
        value = 0.5 * (offset * offset) @ precision
        hessian = np.broadcast_to(np.diag(precision), (len(poses), body.dimension, body.dimension))
        return value, offset * precision, hessian

    def intersection(self, frames: Frames) -> tuple[Array, Array, Array]:
        """Energy, gradient and Hessian of the prior against self-intersection."""
        sigma = self.settings.self_intersection_sigma
        if not np.isfinite(sigma):
            n, d = frames.count, self.body.dimension
            return np.zeros(n), np.zeros((n, d)), np.zeros((n, d, d))
        return self_intersection_energy(self.body, frames, sigma=sigma)
