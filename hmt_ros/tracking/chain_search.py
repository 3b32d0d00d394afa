"""Covariance-scaled sampling of one kinematic chain at a time.

Given the trunk, limbs are nearly independent: instead of 37 degrees of freedom at once, samples of
the four to six of one limb are compared with the image there, and the best are refined. What the
rest of the body explains of the silhouette's outline costs a limb nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.texture import Textures
from hmt_ros.inference.bounded_newton import minimise

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Degrees of freedom of the Student prior that keeps a chain near its prediction: heavy tails.
TAILS = 4.0


@dataclass(frozen=True)
class ChainSearchSettings:
    """How chains are searched.

    Attributes:
        samples: drawn a chain; a third from the mode, a third from it stretched, a third from the
            body's soft prior.
        stretch: of the second third.
        refined: the best samples that are refined.
        iterations: of the refinement.
    """

    samples: int = 48
    stretch: float = 2.5
    refined: int = 3
    iterations: int = 6


@dataclass(frozen=True, eq=False)
class ChainSearch:
    """Finds other configurations of a chain in an image.

    Attributes:
        body, camera, settings: of the likelihood.
        chain: name.
        search: how.
    """

    body: Body
    camera: Camera
    settings: LikelihoodSettings
    chain: str
    search: ChainSearchSettings

    def __post_init__(self) -> None:
        segments = set(self.body.skeleton.chains[self.chain])
        parts = range(len(self.body.flesh.parts))
        own = tuple(i for i in parts if self.body.flesh.parts[i].segment in segments)
        rest = tuple(i for i in parts if i not in own)
        for name, traced, occluders in (('_own', own, None), ('_rest', rest, rest)):
            likelihood = ImageLikelihood(self.body, self.camera, self.settings, traced, occluders)
            object.__setattr__(self, name, likelihood)
        object.__setattr__(self, 'dofs', self.body.skeleton.chain_dofs[self.chain])

    _own: ImageLikelihood = None  # type: ignore[assignment]
    _rest: ImageLikelihood = None  # type: ignore[assignment]
    dofs: Index = None  # type: ignore[assignment]

    def find(
        self,
        pose: Array,
        covariance: Array,
        observation: Observation,
        textures: Textures | None,
        which: int,
        rng: np.random.Generator,
    ) -> Array:
        """Angles (A, chain dofs) of the chain that fit the image, distinct from each other or not.

        Args:
            pose: (d,) whose other chains are kept.
            covariance: (d, d) how far the chain may have moved.
            observation: of the image.
            textures, which: of the last image, and the one that the pose carries.
            rng: source of randomness.
        """
        body, own = self.body, self.dofs
        block = covariance[np.ix_(own, own)]
        precision = np.linalg.inv(block)
        others = self._rest.image_energy(
            forward(body.skeleton, pose[None]), observation, derivatives=False
        )

        def energy(angles: Array, derivatives: bool) -> tuple[Array, Array, Array]:
            poses = np.repeat(pose[None], len(angles), axis=0)
            poses[:, own] = angles
            image = self._own.image_energy(
                forward(body.skeleton, poses), observation, textures,
                np.full(len(angles), which), explained=others.costs, derivatives=derivatives,
            )  # fmt: skip
            value = image.value
            soft = self.settings.prior_weight * body.prior_sigma[own] ** -2.0
            offset = angles - body.prior_mean[own]
            moved = angles - pose[own]
            pulled = moved @ precision
            distance = (moved * pulled).sum(1)
            tails = (TAILS + len(own)) / (TAILS + distance)
            value += 0.5 * (offset * offset) @ soft
            value += 0.5 * (TAILS + len(own)) * np.log1p(distance / TAILS)
            if image.gradient is None or image.hessian is None:
                return value, np.empty(0), np.empty(0)
            gradient = image.gradient[:, own] + offset * soft + tails[:, None] * pulled
            hessian = image.hessian[:, own[:, None], own] + np.diag(soft)
            hessian += tails[:, None, None] * precision
            return value, gradient, hessian

        samples = self._draw(pose[own], block, rng)
        value = energy(samples, False)[0]
        best = samples[np.argsort(value, kind='stable')[: self.search.refined]]
        return minimise(
            lambda x, _: energy(x, True), best, body.lower[own], body.upper[own],
            step_scale=0.4, damping=1.0, max_iterations=self.search.iterations, tolerance=0.05,
        ).x  # fmt: skip

    def _draw(self, angles: Array, block: Array, rng: np.random.Generator) -> Array:
        body, own, n = self.body, self.dofs, self.search.samples
        noise = rng.standard_normal((n, len(own)))
        near = noise @ np.linalg.cholesky(block).T
        near[n // 3 :] *= self.search.stretch
        result = angles + near
        wide = body.prior_mean[own] + 1.3 * body.prior_sigma[own] * noise
        result[2 * n // 3 :] = wide[2 * n // 3 :]
        result[0] = angles
        return np.clip(result, body.lower[own], body.upper[own])
