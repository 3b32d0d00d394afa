"""Kinematic jump sampling: other configurations of the limbs and of the trunk (KJS 3, 4).

For each distinct trunk among the modes, every limb has alternatives: its configurations in the
modes, all their flips, and the results of an image search if no keypoints show the limb or the
image is surprising. Combinations of alternatives are rated on the unchanged trunk, with two limbs
exchanged, and with the torso flipped; the best representatives become candidates.

Covariance-scaled sampling of one limb at a time (KJS 3).

    E(a) = E_image(a) + E_keypoints(a) + E_prior(a) + E_motion(a)      over the angles a of a limb

Given the trunk, limbs are nearly independent. Instead of all 37 degrees of freedom, the four to six
degrees of freedom of one limb are sampled and compared with the image near the limb, and the best
samples are refined. The limb need not explain a part of the silhouette's outline that the rest of
the body explains.
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.flips.limb_products import LimbProducts
from hmt_ros.image.likelihood import ObservedImage
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.image.terms.keypoints import groups_of
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Student
from hmt_ros.inference.error_model import ERRORS
from hmt_ros.inference.linear_algebra import cholesky, inverse, product
from hmt_ros.inference.random_numbers import standard_normals
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.settings import (
    LIKELY_NATS,
    LIMB_TAILS,
    PRIOR_STRETCH,
    SAME_LIMB_DISTANCE,
    SAME_TRUNK_DISTANCE,
    EvaluationPlan,
)

# Change of a variable above which it has jumped, rad or m.
MIN_JUMP = float(np.sqrt(np.finfo(np.float64).eps))


def find_limb(
    posterior: Posterior,
    chain: str,
    pose: Array,
    covariance: Array,
    observation: Observation,
    plan: EvaluationPlan,
    rng: np.random.Generator,
) -> Array:
    """Searches angles (A, chain dofs) of a limb that fit the image; results may repeat.

    Args:
        posterior: energies of poses of the body.
        chain: name of the limb.
        pose: (d,) pose, in which the other limbs are fixed.
        covariance: (d, d) covariance of the predicted pose.
        observation: observation of the image.
        plan: allocation of the image's evaluations.
        rng: source of randomness.
    """
    body, s = posterior.body, posterior.settings.search
    own: Index = np.asarray(body.skeleton.chain_dofs[chain])
    block = covariance[own[:, None], own]
    samples = _drawn(body, own, pose[own], block, s.stretch, plan.samples, rng)
    of_limb, of_rest = posterior.divided[chain]
    others = PoseEnergy(of_rest, (ObservedImage(of_rest, observation),))
    explained = others.by_cue(pose[None], derivatives=False).outline_costs
    seen = ObservedImage(of_limb, observation, explained)
    keypoints = posterior.likelihood.seen(observation)[1:]
    terms = (seen, *keypoints, posterior.likelihood.pose_prior, *posterior.known(observation))
    motion = Student(pose[own], inverse(block), LIMB_TAILS)
    term = PoseEnergy(of_limb, terms, motion, pose, own)
    best = samples[np.argsort(term.values(samples), kind='stable')[: plan.refined]]
    posterior.spent.append(len(samples) + plan.refined * s.iterations)
    return term.minimise(best, max_iterations=s.iterations, tolerance=0.05).x


def _drawn(
    body: Body,
    own: Index,
    angles: Array,
    block: Array,
    stretch: float,
    n: int,
    rng: np.random.Generator,
) -> Array:
    """Draws n samples, a third each from the mode, the stretched mode and the body's prior."""
    noise = standard_normals(rng, (n, len(own)))
    near: Array = product(noise, cholesky(block).T)
    near[n // 3 :] *= stretch
    result = angles + near
    wide = body.prior_mean[own] + PRIOR_STRETCH * body.prior_sigma[own] * noise
    result[2 * n // 3 :] = wide[2 * n // 3 :]
    result[0] = angles
    return np.clip(result, body.lower[own], body.upper[own])


def jumped_poses(search: Search, sources: Hypotheses, rng: np.random.Generator) -> Hypotheses:
    """Proposes combinations of limb and trunk configurations that fit the image."""
    posterior, observation, plan = search.posterior, search.observation, search.plan
    base, body = search.base, posterior.body
    limbs = limbs_not_shown(posterior, observation, plan.surprising)
    left = plan.rated if limbs else plan.rated_alone
    share = ERRORS['image'].share(search.dt)
    price = {name: x.price(search.dt) for name, x in body.symmetries.items()}
    everything: list[tuple[Array, Index, Array]] = []
    image, groups = posterior.of_image(observation), _groups(search)
    prior = search.base_rated
    for group in groups[: plan.groups]:
        likely = prior[group].max() > prior.max() - LIKELY_NATS
        products = LimbProducts.of(
            body,
            base.x[group],
            _search_limbs(limbs, search, base.x[group[0]], sources.ancestors[group[0]], rng)
            if likely
            else {},
            price['limb_flip'],
            apart=SAME_LIMB_DISTANCE,
            most=plan.alternatives,
            poses=left,
        )
        alone, rows = products.alone
        left -= len(rows)
        best = products.best(
            image.values(alone)[rows],
            sources.log_weights[group],
            exchange=price['exchange'],
            flip=price['trunk_flip'],
            share=share,
            count=plan.combinations,
        )
        everything.append((best.poses, group[best.parents], best.energies))
    others = np.array([k for group in groups[plan.groups :] for k in group], dtype=np.intp)
    if len(others):
        poses = base.x[others]
        everything.append((poses, others, image.values(poses)))
    poses, members, energies = (np.concatenate(parts) for parts in zip(*everything, strict=True))
    kept = search.best(poses, energies)
    poses, members = poses[kept], members[kept]
    # The motion prior is centred at the new value of a jumped variable, otherwise at the
    # prediction.
    jumped = np.abs(poses - base.x[members]) > MIN_JUMP
    return sources.proposed(members, poses, jumped)


def _groups(search: Search) -> list[Index]:
    """Groups modes with nearly the same trunk; the best mode of a group is the first."""
    skeleton = search.posterior.body.skeleton
    trunk = search.base_joints[:, skeleton.joint_index(skeleton.trunk_joints)]
    left = np.argsort(search.base.value, kind='stable')
    groups = []
    while len(left):
        away = trunk[left] - trunk[left[0]]
        near = np.sqrt((away * away).sum(2)).max(1) < SAME_TRUNK_DISTANCE
        groups.append(left[near])
        left = left[~near]
    return groups


def limbs_not_shown(posterior: Posterior, observation: Observation, surprising: bool) -> list[str]:
    """Names of limbs to search in an image: limbs without keypoints, or all if it is surprising.

    Two keypoints determine a limb up to its flips; samples away from them mostly fit other limbs or
    the background. In a surprising image the keypoints may be wrong.
    """
    if not {'coverage', 'edges'} & observation.evidence.keys():
        return []
    names, keypoints = list(posterior.divided), observation.keypoints
    if surprising or keypoints is None or posterior.settings.likelihood.keypoints.weight == 0:
        return names
    skeleton, beliefs = posterior.body.skeleton, observation.beliefs
    seen = {name for name, known in zip(keypoints.names, keypoints.seen, strict=True) if known}

    def shown(limb: str) -> bool:
        group = groups_of(skeleton)[skeleton.chains[limb][0]]
        if beliefs is not None and beliefs.keypoints[group] < 0.5:
            return False
        joints = (skeleton.joint_names[j] for j in skeleton.chain_joints[limb])
        return len(seen.intersection(joints)) >= 2

    return [limb for limb in names if not shown(limb)]


def _search_limbs(
    limbs: list[str], search: Search, pose: Array, ancestor: int, rng: np.random.Generator
) -> dict[str, Array]:
    """Searches configurations of randomly chosen limbs that fit the image.

    Args:
        limbs: names of the limbs to choose from.
        search: inputs and optima of the image.
        pose: (d,) first pose of a group, in which the other limbs are fixed.
        ancestor: row of the ancestor of the pose.
        rng: source of randomness.
    """
    count = min(search.plan.searched_chains, len(limbs))
    if count == 0:
        return {}
    covariance = search.states.searched[ancestor]
    posterior, observation, plan = search.posterior, search.observation, search.plan
    return {
        limbs[i]: find_limb(posterior, limbs[i], pose, covariance, observation, plan, rng)
        for i in sorted(rng.choice(len(limbs), size=count, replace=False))
    }
