"""Kinematic jump sampling: other configurations of the limbs and of the trunk (KJS 3, 4).

For each trunk that the modes have, every limb has alternatives: those of the modes, all their
flips, and, where no keypoints show it or the image is surprising, the results of an image search.
Combinations of alternatives are rated on the trunk as it is, with limbs exchanged that were taken
for each other, and with the torso flipped; the best that stand for all become candidates.

Covariance-scaled sampling of one limb at a time (KJS 3).

    E(a) = E_image(a) + E_keypoints(a) + E_prior(a) + E_motion(a)      over the angles a of a limb

Given the trunk, limbs are nearly independent: instead of 37 degrees of freedom at once, samples of
the four to six of one limb are compared with the image there, and the best are refined. The part of
the silhouette's outline that the rest of the body explains costs a limb nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hmt_ros.flips.limb_products import LimbProducts
from hmt_ros.image.likelihood import ImageLikelihood, ObservedImage
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.keypoints import group_of
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.energy import Derivatives, Student
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.selection import choose_hypotheses
from hmt_ros.tracking.settings import (
    LIKELY_NATS,
    LIMB_TAILS,
    PRIOR_STRETCH,
    SAME_LIMB_DISTANCE,
    SAME_TRUNK_DISTANCE,
    EvaluationPlan,
)


@dataclass(frozen=True, eq=False)
class LimbSearch:
    """Finds other configurations of a limb in an image.

    Attributes:
        posterior: of the body before the camera.
        chain: name of the limb.
    """

    posterior: Posterior
    chain: str

    @cached_property
    def dofs(self) -> Index:
        """Degrees of freedom of the limb."""
        return np.asarray(self.posterior.body.skeleton.chain_dofs[self.chain])

    @cached_property
    def _likelihoods(self) -> tuple[ImageLikelihood, ImageLikelihood]:
        """Those of the limb, and of the rest of the body without the limb."""
        body, whole = self.posterior.body, self.posterior.likelihood
        segments = set(body.skeleton.chains[self.chain])
        of_limb = [part.segment in segments for part in body.flesh.parts]
        own = tuple(i for i, ours in enumerate(of_limb) if ours)
        rest = tuple(i for i, ours in enumerate(of_limb) if not ours)
        return replace(whole, parts=own), replace(whole, parts=rest, occluders=rest)

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
            plan: allocation of its evaluations.
            rng: source of randomness.
        """
        s, own = self.posterior.settings.search, self.dofs
        block = covariance[np.ix_(own, own)]
        samples = self._draw(pose[own], block, plan.samples, rng)
        of_limb, of_rest = self._likelihoods
        others = PoseEnergy(of_rest, (ObservedImage(of_rest, observation),))
        explained = others.by_cue(pose[None], derivatives=False).outline_costs
        seen = of_limb.seen(observation, explained=explained)
        terms = (*seen, self.posterior.likelihood.pose_prior, *self.posterior.known)
        motion = Student(pose[own], np.asarray(np.linalg.inv(block)), LIMB_TAILS)
        term = PoseEnergy(of_limb, terms, motion, pose, own)
        value = term.energy(samples, np.arange(len(samples)), derivatives=Derivatives.NONE).value
        best = samples[np.argsort(value, kind='stable')[: plan.refined]]
        self.posterior.spent.append(len(samples) + plan.refined * s.iterations)
        return term.minimise(best, max_iterations=s.iterations, tolerance=0.05).x

    def _draw(self, angles: Array, block: Array, n: int, rng: np.random.Generator) -> Array:
        """N samples from the mode, from it stretched, and from the body's prior: a third each."""
        body, own, search = self.posterior.body, self.dofs, self.posterior.settings.search
        noise = rng.standard_normal((n, len(own)))
        near = noise @ np.linalg.cholesky(block).T
        near[n // 3 :] *= search.stretch
        result = angles + near
        wide = body.prior_mean[own] + PRIOR_STRETCH * body.prior_sigma[own] * noise
        result[2 * n // 3 :] = wide[2 * n // 3 :]
        result[0] = angles
        return np.clip(result, body.lower[own], body.upper[own])


@dataclass(frozen=True, eq=False)
class KinematicJumps:
    """Proposes poses far from those that are known, which fit the image as well.

    Attributes:
        posterior: of the body before the camera.
    """

    posterior: Posterior

    def propose(
        self, search: Search, base: Minimum, sources: Hypotheses, rng: np.random.Generator
    ) -> Hypotheses:
        """See `Proposal`."""
        s, body = self.posterior.settings, self.posterior.body
        plan, limbs = search.plan, self._not_shown(search.observation, search.plan.surprising)
        left = plan.rated if limbs else plan.rated_alone
        share = ERRORS['image'].share(search.dt)
        price = {name: x.price(search.dt) for name, x in body.symmetries.items()}
        everything: list[tuple[Array, Index, Array]] = []
        prior = search.rated(base.x, base.value)
        groups = self._groups(base)
        for group in groups[: plan.groups]:
            likely = prior[group].max() > prior.max() - LIKELY_NATS
            products = LimbProducts.of(
                body,
                base.x[group],
                self._search(limbs, search, base.x[group[0]], sources.ancestors[group[0]], rng)
                if likely
                else {},
                price['limb_flip'],
                apart=SAME_LIMB_DISTANCE,
                most=plan.alternatives,
            ).at_most(left)
            alone = products.alone
            left -= len(alone)
            best = products.best(
                self.posterior.values(alone, search.observation),
                sources.log_weights[group],
                exchange=price['exchange'],
                flip=price['trunk_flip'],
                share=share,
                count=plan.combinations,
            )
            everything.append((best.poses, group[best.parents], best.energies))
        others = [k for group in groups[plan.groups :] for k in group]
        if others:
            poses = base.x[others]
            energies = self.posterior.values(poses, search.observation)
            everything.append((poses, np.array(others, dtype=np.intp), energies))
        poses, members, energies = (
            np.concatenate([part[i] for part in everything]) for i in range(3)
        )
        kept = choose_hypotheses(
            self.posterior.body.relative_joints(poses),
            search.rated(poses, energies),
            plan.candidates,
            same=s.hypothesis_merge_distance,
        ).chosen
        poses, members = poses[kept], members[kept]
        # A chain that jumped is expected where it landed, the rest where it was predicted.
        jumped = np.abs(poses - base.x[members]) > np.sqrt(np.finfo(np.float64).eps)
        return sources.proposed(members, poses, jumped)

    @cached_property
    def _searches(self) -> dict[str, LimbSearch]:
        pairs = self.posterior.body.chain_pairs
        return {chain: LimbSearch(self.posterior, chain) for pair in pairs for chain in pair}

    def _groups(self, base: Minimum) -> list[Index]:
        """Modes with nearly the same trunk, each group with its best mode first."""
        which = self.posterior.body.skeleton.joint_index(self.posterior.body.trunk_joints)
        trunk = self.posterior.body.joint_positions(base.x)[:, which]
        left = list(np.argsort(base.value, kind='stable'))
        groups = []
        while left:
            gaps = np.linalg.norm(trunk[left] - trunk[left[0]], axis=2).max(1)
            near = gaps < SAME_TRUNK_DISTANCE
            groups.append(np.array([i for i, ok in zip(left, near) if ok], dtype=np.intp))
            left = [i for i, ok in zip(left, near) if not ok]
        return groups

    def _not_shown(self, observation: Observation, surprising: bool) -> list[str]:
        """The limbs that an image is searched for: those that no keypoints show.

        Two keypoints fix a limb but for its flips; samples beside them mostly find other limbs and
        the background. Where an image is surprising the keypoints may be wrong.
        """
        if not {'coverage', 'edges'} & observation.evidence.keys():
            return []
        names, keypoints = list(self._searches), observation.keypoints
        if (
            surprising
            or keypoints is None
            or self.posterior.settings.likelihood.keypoints.weight == 0
        ):
            return names
        skeleton, beliefs = self.posterior.body.skeleton, observation.beliefs
        seen = {name for name, known in zip(keypoints.names, keypoints.seen, strict=True) if known}

        def shown(limb: str) -> bool:
            if beliefs is not None:
                group = group_of(skeleton, skeleton.chains[limb][0])
                if beliefs.keypoints[group] < 0.5:
                    return False
            joints = (skeleton.joint_names[j] for j in skeleton.chain_joints[limb])
            return len(seen.intersection(joints)) >= 2

        return [limb for limb in names if not shown(limb)]

    def _search(
        self,
        limbs: list[str],
        search: Search,
        pose: Array,
        ancestor: int,
        rng: np.random.Generator,
    ) -> dict[str, Array]:
        """Configurations of some limbs that fit the image, where the others are as in a pose (d,).

        Args:
            limbs: that may be searched for.
            search: of the image.
            pose: (d,) the first of a group.
            ancestor: of it.
            rng: source of randomness.
        """
        plan = search.plan
        count = min(plan.searched_chains, len(limbs))
        if count == 0:
            return {}
        chosen = rng.choice(len(limbs), size=count, replace=False)
        covariance = search.states.searched[ancestor]
        return {
            limbs[i]: self._searches[limbs[i]].find(pose, covariance, search.observation, plan, rng)
            for i in sorted(chosen)
        }
