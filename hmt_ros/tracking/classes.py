"""Classes of a hypothesis that are chains: the way that it faces, and the sides of the detector.

Facing direction of the person: a two-state chain, whose evidence lasts as long as the track.

    S_t- = max(logit [exp(Q dt)] p_(t-1), max min(log t(x_k, x_j), log h(x_k, x_j))),
                                                                   j as the track faces, k not  (1)
    S_t  = S_t- + b(min e_k (as the track faces) - min e_k (the other way))                     (2)
    b(d) = log (v e^d + 1 - v) - log (v + (1 - v) e^d)                                          (3)

A camera hardly tells a pose from its reversal in depth (`body.mirror`), and a wrong one does not
come right by small steps. S = logit p are the log odds that the person faces the other way than the
heaviest mode, Q the rate of the symmetry `reversal` (`body.body`), e_k the energy of an image at
mode k. Nobody turns about from one image to the next: a hypothesis that faces the other way is
another history of the track, weighed with the evidence of all images so far for that history,
whether a mode was kept of it or not. Seen from the side the two histories meet (1): t is the
transition of the joints (`weighting`), h that of the heading, which wanders at the rate of the
body. The best motion of either way stands for it (2), as the number of its modes is no evidence,
nor is a motion that was not followed. An image shows the facing direction with the probability v,
else something unrelated, like a flash or a covered lens (3): no single image turns a track about.
A mode holds the odds of its own way: -S, or S where it faces back. To the ancestry of the modes a
pair that faces different ways has

    log t(x_k, x_j) = log (exp min(log t, log h) + [exp(Q dt)]_ww')                             (6)

Exchange of left and right by the detector, in each mode from image to image:

    p(e_t | m) = sum_e' p(e_t | e') p(e' | ancestor of m),     p(e_t | e') = [exp(Q dt)]_e'e    (4)
    p(e_t | m, keypoints) ~ p(e_t | m) exp(-E_e(x_m))                                           (5)

Q are the rates at which detectors begin and cease to exchange sides (`image.keypoint_schemes`). A
person who is turned about and whose sides are exchanged looks the same to the keypoints as one who
is not: the two differ in that people turn slowly and detectors change their mind at once.
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
from hmt_ros.tracking.settings import FACING_VALID, LEAST_EXCHANGE, MAX_FACING_NATS
from hmt_ros.tracking.weighting import Continuity

EXCHANGES = MarkovChain(exchange_rates())


# The way to face.


class Ways(NamedTuple):
    """What is known of the two ways when hypotheses are weighed, for the core.

    Attributes:
        before: (K,) modes that face the other way than the heaviest.
        back: (N,) hypotheses that do.
        variance: of turns since the image before, rad^2.
        log_odds: of the other way, as the chain goes on.
        price: -log of the probability that the way has changed meanwhile, nats.
        valid: share of the images that show the facing direction.
        most: bound on the log odds.
    """

    before: Mask
    back: Mask
    variance: float
    log_odds: float
    price: float
    valid: float
    most: float


def ways(body: Body, joints: Array, reference: Array) -> Mask:
    """Whether poses with joints (N, J, 3) face the other way than one with joints (J, 3).

    With a body without a trunk none does.
    """
    if not body.trunk_pairs:
        return np.zeros(len(joints), dtype=np.bool_)
    return faces_back(body, joints, reference)


def first_facing(body: Body, joints: Array, log_weights: Array) -> Array:
    """Log odds (N,) of the way that each pose, by its joints, faces at the start of a track."""
    back = ways(body, joints, joints[np.argmax(log_weights)])
    log_odds = -MAX_FACING_NATS
    if back.any():
        log_odds = max(float(log_weights[back].max() - log_weights[~back].max()), -MAX_FACING_NATS)
    return np.where(back, log_odds, -log_odds)


def lost_a_facing(back: Mask, log_weights: Array) -> bool:
    """Whether no mode of comparable weight faces one of the two ways.

    Args:
        back: (K,) modes that face the other way than the heaviest.
        log_weights: (K,) of the modes in the image.
    """
    one_way = not back.any() or back.all()
    return bool(one_way or log_weights[back].max() > log_weights[~back].max() + MAX_FACING_NATS)


def best_of_the_other_way(body: Body, joints: Array, log_weights: Array, least: float) -> list[int]:
    """The heaviest of N poses that faces the other way than the heaviest of all, if any.

    It is kept as long as its way has any mass: small steps do not lead back to it.

    Args:
        body: of the poses.
        joints, log_weights: (N, J, 3), (N,).
        least: log weight relative to the heaviest below which a way has no mass.
    """
    best = int(np.argmax(log_weights))
    back = np.flatnonzero(ways(body, joints, joints[best]))
    back = back[log_weights[back] >= log_weights[best] + least]
    return [int(back[np.argmax(log_weights[back])])] if len(back) else []


def weigh_ways(
    modes: Modes,
    continuity: Continuity,
    joints: Array,
    transitions: Array,
    log_weights: Array,
    evidence: Array,
    followed: Mask,
) -> tuple[Array, Array, Array]:
    """Log weights (N,) of poses, in which either way has the weight of its history.

    Args:
        modes: of the image before, K.
        continuity: of the image, with the poses that they are moved to.
        joints: (N, J, 3) of the poses, m.
        transitions: (K, N) log t(x_n, x_k) from the modes.
        log_weights: (N,); only their ratios within a way are used.
        evidence: (N,) energies of the image, nats.
        followed: (N,) whether each has moved on from a mode.

    Returns:
        The log weights, the log odds (N,) of the way that each faces, and what (6) adds to log t
        (K, N).
    """
    body, dt = continuity.body, continuity.dt
    log_odds = -float(modes.facing[0])
    facing, turned = np.full(len(joints), -log_odds), np.zeros_like(transitions)
    if not body.trunk_pairs:
        return log_weights, facing, turned
    reversal = body.symmetries['reversal']
    of_ways = Ways(
        modes.back,
        ways(body, joints, body.joint_positions(modes.poses[:1])[0]),
        # People turn about as far as their pelvis wanders about the vertical by itself.
        float(body.rates[root_rotation_dofs(body.skeleton)[0]]) * dt,
        reversal.after(log_odds, dt),
        reversal.price(dt),
        FACING_VALID,
        MAX_FACING_NATS,
    )
    result, first = np.empty_like(log_weights), continuity.joints
    core.weigh_ways(
        trunk_of(body), of_ways, first, joints, transitions, log_weights, evidence, followed,
        result, facing, turned,
    )  # fmt: skip
    return result, facing, turned


# The sides.


def predicted_exchanges(exchanges: Array, dt: float) -> Array:
    """Log probabilities (K, E) of exchanges of sides a time dt, s, later, (4)."""
    p = EXCHANGES.predict(elementary.exp(exchanges), dt)
    return np.asarray(elementary.log(np.maximum(p, LEAST_EXCHANGE)), dtype=np.float64)


def known_exchanges(exchanges: Array) -> Array:
    """Log probabilities (N, E) of exchanges of sides, where nothing is known the usual ones."""
    return np.where(np.isnan(exchanges), usual_exchanges(), exchanges)


def seen_exchanges(
    likelihood: ImageLikelihood, observation: Observation, poses: Array, exchanges: Array
) -> Array:
    """Log probabilities (K, E) of exchanges of sides after an image, (5).

    Args:
        likelihood: of the body.
        observation: of the image; without keypoints nothing changes.
        poses: (K, d) modes.
        exchanges: (K, E) of the modes, before the image.
    """
    if observation.keypoints is None or likelihood.settings.keypoints.weight == 0:
        return exchanges
    term = likelihood.keypoint_term(observation, known_exchanges(exchanges))
    return term.exchanged(forward(likelihood.body.skeleton, poses), np.arange(len(poses)))
