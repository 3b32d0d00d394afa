"""Facing direction of the person: a two-state chain, whose evidence lasts as long as the track.

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
"""

from __future__ import annotations

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import faces_back, left_directions, root_rotation_dofs
from hmt_ros.inference.arrays import Array, Mask

# Probability v that the evidence of an image for a facing direction is about the person.
VALID = 0.9
# Largest log odds that are counted, nats: those against a way that a start does not contain.
MOST = 10.0


class Facing:
    """Facing direction of the person of one track.

    Attributes:
        log_odds: S, that the person faces the other way than the leading mode, the heaviest.
        back: (K,) modes that face the other way than that one.
    """

    def __init__(self) -> None:
        self.log_odds = -MOST
        self.back: Mask = np.zeros(0, dtype=np.bool_)
        self._lead: Array | None = None

    def start(self, body: Body, poses: Array, log_weights: Array) -> None:
        """Takes in poses (N, d) at the start of a track, with their log weights (N,)."""
        self.log_odds = -MOST
        self._lead = poses[np.argmax(log_weights)]
        if not body.trunk_pairs:
            return
        back = faces_back(body, poses, self._lead)
        if back.any():
            self.log_odds = max(float(log_weights[back].max() - log_weights[~back].max()), -MOST)

    def lacks_a_way(self, log_weights: Array) -> bool:
        """Whether the modes, log weights (K,), have lost one of the two ways.

        A way is lost if it has no mode, or none that the odds could make up for.
        """
        back = self.back
        one_way = not back.any() or back.all()
        return bool(one_way or log_weights[back].max() > log_weights[~back].max() + MOST)

    def lead(self, body: Body, poses: Array) -> None:
        """Makes the first of the modes, poses (K, d), the reference for the facing direction."""
        before = self._lead
        if before is not None and body.trunk_pairs and faces_back(body, poses[:1], before)[0]:
            self.log_odds = -self.log_odds
        self.carry(body, poses)

    def carry(self, body: Body, poses: Array) -> None:
        """Takes in the same modes, (K, d), in the frame of a camera that has moved."""
        self._lead = poses[0]
        if body.trunk_pairs:
            self.back = faces_back(body, poses, self._lead)

    def weigh(
        self,
        body: Body,
        poses: Array,
        transitions: Array,
        log_weights: Array,
        evidence: Array,
        followed: Mask,
        dt: float,
        predicted: Array,
    ) -> Array:
        """Log weights (N,) of poses (N, d), in which either way has the weight of its history.

        Args:
            body: of the poses.
            poses: (N, d).
            transitions: (K, N) log t(x_n, x_k) from the modes.
            log_weights: (N,); only their ratios within a way are used.
            evidence: (N,) energies of the image, nats.
            followed: (N,) whether each has moved on from a mode.
            dt: time since the image before, s.
            predicted: (K, d) poses that the modes are moved to.
        """
        if self._lead is None or not body.trunk_pairs:
            return log_weights
        back = faces_back(body, poses, self._lead)
        across = np.minimum(
            transitions[np.ix_(~self.back, back)],
            log_turns(body, predicted[~self.back], poses[back], dt),
        )
        stayed = body.symmetries['reversal'].after(self.log_odds, dt)
        log_odds = max(stayed, float(across.max(initial=-np.inf)))
        on, off = followed & ~back, followed & back
        if on.any() and off.any():
            log_odds += believed(float(evidence[on].min() - evidence[off].min()))
        self.log_odds = log_odds = float(np.clip(log_odds, -MOST, MOST))
        if back.all():
            # All modes went over: the track is as sure of this way as it was of the other one.
            self.log_odds = abs(log_odds)
        if back.all() or not back.any():
            return log_weights
        result = log_weights.copy()
        for which, odds in ((back, log_odds), (~back, -log_odds)):
            share = -np.logaddexp(0.0, -odds)
            result[which] += share - np.logaddexp.reduce(log_weights[which])
        return result


def log_turns(body: Body, first: Array, last: Array, dt: float) -> Array:
    """How well people turn from poses (M, d) to poses (N, d) in dt s, (M, N), nats below the best.

    They turn about as far as their pelvis wanders about the vertical by itself (`Body.rates`).
    """
    cosines = left_directions(body, first) @ left_directions(body, last).T
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    variance = body.rates[root_rotation_dofs(body.skeleton)[0]] * dt
    return np.asarray(-0.5 * angles**2 / variance)


def believed(evidence: float) -> float:
    """Evidence for a facing direction, bounded as an image may show something else, (3)."""
    valid, other = np.log(VALID), np.log1p(-VALID)
    return float(np.logaddexp(valid + evidence, other) - np.logaddexp(valid, other + evidence))
