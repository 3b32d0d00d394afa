"""Markov chains of each hypothesis: facing direction, and sides exchanged by the detector.

Facing direction of the person: a two-state chain, which uses all images of the track.

    S_t- = max(logit [exp(Q dt)] p_(t-1), max min(log t(x_k, x_j), log h(x_k, x_j))),
                                                                   j faces as the track, k not  (1)
    S_t  = S_t- + b(min e_k (as the track faces) - min e_k (the other way))                     (2)
    b(d) = log (v e^d + 1 - v) - log (v + (1 - v) e^d)                                          (3)

A camera hardly distinguishes a pose from its reversal in depth (`body.mirror`), and small steps do
not correct a wrong facing direction. S = logit p are the log odds that the person faces opposite to
the heaviest mode, Q the rates of the symmetry `reversal` (`body.body`), e_k the energy of an image
at mode k. Nobody turns round between two images, so a hypothesis that faces the other way belongs
to another history of the track. Its weight includes the evidence of all images so far for that
history, even if no mode of that history was kept. In a side view the two histories join (1): t is
the transition density of the joints (`weighting`), h the transition density of the heading, which
diffuses at the rate of the body. The best mode represents its facing direction (2), because neither
the number of modes nor a jumped mode is evidence for it. An image shows the facing direction with
the probability v, otherwise something unrelated, such as a flash or a covered lens (3): no single
image reverses a track. A mode stores the log odds of its own facing direction: -S, or S if it faces
opposite to the heaviest mode. For the ancestry of the modes, the transition density between poses
of opposite facing directions is

    log t(x_k, x_j) = log (exp min(log t, log h) + [exp(Q dt)]_ww')                             (6)

Exchange of left and right by the detector, in each mode from image to image:

    p(e_t | m) = sum_e' p(e_t | e') p(e' | ancestor of m),     p(e_t | e') = [exp(Q dt)]_e'e    (4)
    p(e_t | m, keypoints) ~ p(e_t | m) exp(-E_e(x_m))                                           (5)

Q are the rates at which detectors start and stop exchanging sides (`image.keypoint_schemes`). A
reversed pose with exchanged sides explains the same keypoints as the pose itself. The only
difference is that people turn slowly, while detectors exchange sides at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hmt_ros import core
from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import faces_back, root_rotation_dofs, trunk_of
from hmt_ros.core import elementary
from hmt_ros.image.keypoint_schemes import exchange_rates, usual_exchanges
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.inference.markov_chain import MarkovChain
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.settings import FACING_VALIDITY, MAX_FACING_NATS, MIN_EXCHANGE_PROBABILITY
from hmt_ros.tracking.weighting import TransitionPrior

EXCHANGE_CHAIN = MarkovChain(exchange_rates())


# The facing direction.


class FacingInputs(NamedTuple):
    """Inputs for the compiled function that weighs hypotheses of both facing directions.

    Attributes:
        before: (K,) whether each mode faces opposite to the heaviest mode.
        back: (N,) whether each hypothesis faces opposite to the heaviest mode.
        variance: variance of the turn since the previous image, rad^2.
        log_odds: log odds of the other facing direction, predicted by the chain.
        price: -log of the probability of a change of facing direction since the previous image,
            nats.
        valid: probability v that an image shows the facing direction.
        most: maximum absolute value of the log odds.
    """

    before: Mask
    back: Mask
    variance: float
    log_odds: float
    price: float
    valid: float
    most: float


def ways(body: Body, joints: Array, reference: Array) -> Mask:
    """Whether poses with joints (N, J, 3) face opposite to a reference with joints (J, 3).

    All False for a body without a trunk.
    """
    if not body.trunk_pairs:
        return np.zeros(len(joints), dtype=np.bool_)
    return faces_back(body, joints, reference)


def first_facing(body: Body, joints: Array, log_weights: Array) -> Array:
    """Log odds (N,) of each pose's facing direction at the start of a track."""
    back = ways(body, joints, joints[np.argmax(log_weights)])
    log_odds = -MAX_FACING_NATS
    if back.any():
        log_odds = max(float(log_weights[back].max() - log_weights[~back].max()), -MAX_FACING_NATS)
    return np.where(back, log_odds, -log_odds)


def lost_a_facing(back: Mask, log_weights: Array) -> bool:
    """Whether one of the two facing directions has no mode of comparable weight.

    Args:
        back: (K,) whether each mode faces opposite to the heaviest mode.
        log_weights: (K,) log weights of the modes in the image.
    """
    one_way = not back.any() or back.all()
    return bool(one_way or log_weights[back].max() > log_weights[~back].max() + MAX_FACING_NATS)


def best_of_other_facing(body: Body, joints: Array, log_weights: Array, least: float) -> list[int]:
    """Index of the heaviest pose that faces opposite to the overall heaviest, if any.

    The pose is kept while its facing direction has any weight, because small steps would not find
    it again.

    Args:
        body: body of the poses.
        joints, log_weights: joints (N, J, 3) and log weights (N,) of the poses.
        least: log weight, relative to the heaviest pose, below which a pose is ignored.
    """
    best = int(np.argmax(log_weights))
    back = np.flatnonzero(ways(body, joints, joints[best]))
    back = back[log_weights[back] >= log_weights[best] + least]
    return [int(back[np.argmax(log_weights[back])])] if len(back) else []


def weigh_ways(
    modes: Modes,
    transition_prior: TransitionPrior,
    joints: Array,
    transitions: Array,
    log_weights: Array,
    evidence: Array,
    followed: Mask,
) -> tuple[Array, Array, Array]:
    """Log weights (N,) of poses in which each facing direction has the weight of its history.

    Args:
        modes: K modes of the previous image.
        transition_prior: transition densities to the image, with the predicted poses of the modes.
        joints: (N, J, 3) joints of the poses, m.
        transitions: (K, N) log transition densities t(x_n, x_k) from the modes.
        log_weights: (N,) log weights; only their differences within a facing direction are used.
        evidence: (N,) energies of the image at the poses, nats.
        followed: (N,) False for poses that jumped in all degrees of freedom.

    Returns:
        The log weights, the log odds (N,) of each pose's facing direction, and the term (K, N) to
        add to log t according to (6).
    """
    body, dt = transition_prior.body, transition_prior.dt
    log_odds = -float(modes.facing[0])
    facing, turned = np.full(len(joints), -log_odds), np.zeros_like(transitions)
    if not body.trunk_pairs:
        return log_weights, facing, turned
    reversal = body.symmetries['reversal']
    of_ways = FacingInputs(
        modes.back,
        ways(body, joints, body.joint_positions(modes.poses[:1])[0]),
        # The heading diffuses at the rate of the pelvis's rotation about the vertical.
        float(body.rates[root_rotation_dofs(body.skeleton)[0]]) * dt,
        reversal.after(log_odds, dt),
        reversal.price(dt),
        FACING_VALIDITY,
        MAX_FACING_NATS,
    )
    result, first = np.empty_like(log_weights), transition_prior.joints
    core.weigh_ways(
        trunk_of(body), of_ways, first, joints, transitions, log_weights, evidence, followed,
        result, facing, turned,
    )  # fmt: skip
    return result, facing, turned


# The sides.


def predicted_exchanges(exchanges: Array, dt: float) -> Array:
    """Predicts log probabilities (K, E) of exchanged sides dt seconds ahead, equation (4)."""
    p = EXCHANGE_CHAIN.predict(elementary.exp(exchanges), dt)
    return np.asarray(elementary.log(np.maximum(p, MIN_EXCHANGE_PROBABILITY)), dtype=np.float64)


def known_exchanges(exchanges: Array) -> Array:
    """Replaces unknown log probabilities (N, E) of exchanged sides with their usual values."""
    return np.where(np.isnan(exchanges), usual_exchanges(), exchanges)


def seen_exchanges(
    likelihood: ImageLikelihood, observation: Observation, poses: Array, exchanges: Array
) -> Array:
    """Log probabilities (K, E) of exchanged sides given an image, equation (5).

    Args:
        likelihood: likelihood of the body.
        observation: observation of the image; without keypoints, `exchanges` is returned.
        poses: (K, d) poses of the modes.
        exchanges: (K, E) log probabilities of exchanged sides, given earlier images.
    """
    if observation.keypoints is None or likelihood.settings.keypoints.weight == 0:
        return exchanges
    term = likelihood.keypoint_term(observation, known_exchanges(exchanges))
    return term.exchanged(forward(likelihood.body.skeleton, poses), np.arange(len(poses)))
