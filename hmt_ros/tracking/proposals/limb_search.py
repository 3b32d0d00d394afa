"""Covariance-scaled sampling of one limb at a time (KJS 3).

    E(a) = E_image(a) + E_keypoints(a) + E_prior(a) + E_motion(a)      over the angles a of a limb

Given the trunk, limbs are nearly independent: instead of 37 degrees of freedom at once, samples of
the four to six of one limb are compared with the image there, and the best are refined. What the
rest of the body explains of the silhouette's outline costs a limb nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hmt_ros.body.kinematics import forward
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Student
from hmt_ros.tracking.evaluation_plan import EvaluationPlan
from hmt_ros.tracking.posterior import Posterior

# Degrees of freedom of the Student prior that keeps a limb near its prediction: heavy tails.
TAILS = 4.0
# Factor on the standard deviations of the body's prior, of the samples that are drawn from it.
WIDE = 1.3


@dataclass(frozen=True, eq=False)
class LimbSearch:
    """Finds other configurations of a limb in an image.

    Attributes:
        posterior: of the body before the camera.
        chain: name of the limb.
    """

    posterior: Posterior
    chain: str

    def __post_init__(self) -> None:
        p = self.posterior
        segments = set(p.body.skeleton.chains[self.chain])
        parts = range(len(p.body.flesh.parts))
        own = tuple(i for i in parts if p.body.flesh.parts[i].segment in segments)
        rest = tuple(i for i in parts if i not in own)
        for name, traced, occluders in (('_own', own, None), ('_rest', rest, rest)):
            likelihood = replace(p.likelihood, parts=traced, occluders=occluders)
            object.__setattr__(self, name, likelihood)
        object.__setattr__(self, 'dofs', p.body.skeleton.chain_dofs[self.chain])

    _own: ImageLikelihood = None  # type: ignore[assignment]
    _rest: ImageLikelihood = None  # type: ignore[assignment]
    dofs: Index = None  # type: ignore[assignment]

    def find(
        self,
        pose: Array,
        covariance: Array,
        observation: Observation,
        plan: EvaluationPlan,
        rng: np.random.Generator,
    ) -> Array:
        """Angles (A, chain dofs) of the limb that fit the image, distinct from each other or not.

        Args:
            pose: (d,) whose other limbs are kept.
            covariance: (d, d) how far the limb may have moved.
            observation: of the image.
            plan: what its evaluations are spent on.
            rng: source of randomness.
        """
        body, own = self.posterior.body, self.dofs
        s = self.posterior.settings.search
        block = covariance[np.ix_(own, own)]
        samples = self._draw(pose[own], block, plan.samples, rng)
        others = self._rest.energies(
            forward(body.skeleton, pose[None]), observation, derivatives=False
        )
        seen = self._own.seen(observation, explained=others.costs)
        seen = (*seen, self.posterior.likelihood.pose_prior, *self.posterior.known)
        motion = Student(pose[own], np.asarray(np.linalg.inv(block)), TAILS)
        term = PoseEnergy(self._own, seen, motion, pose, own)
        value = term.energy(samples, np.arange(len(samples)), derivatives=Derivatives.NONE).value
        best = samples[np.argsort(value, kind='stable')[: plan.refined]]
        self.posterior.evaluations += len(samples) + plan.refined * s.iterations
        return term.minimise(
            best, step_scale=0.4, damping=1.0, max_iterations=s.iterations, tolerance=0.05
        ).x

    def _draw(self, angles: Array, block: Array, n: int, rng: np.random.Generator) -> Array:
        """N samples from the mode, from it stretched, and from the body's prior: a third each."""
        body, own, search = self.posterior.body, self.dofs, self.posterior.settings.search
        noise = rng.standard_normal((n, len(own)))
        near = noise @ np.linalg.cholesky(block).T
        near[n // 3 :] *= search.stretch
        result = angles + near
        wide = body.prior_mean[own] + WIDE * body.prior_sigma[own] * noise
        result[2 * n // 3 :] = wide[2 * n // 3 :]
        result[0] = angles
        return np.clip(result, body.lower[own], body.upper[own])
