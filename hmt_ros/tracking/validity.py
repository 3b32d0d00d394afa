"""Validity of the track and of the cues of the images, as two-state chains.

    P <- [exp(Q dt)] x ... x [exp(Q dt)] P          the track and each cue fail, and recover     (1)
    e_g = E_outlier - E_inlier = N (u - m_g)        m_g: share of cue g that is not explained    (2)
    log P(v) <- log P(v) + a(dt) v_0 (e_0 + sum_g v_g e_g)                                       (3)

P is the joint probability of v = (v_0, v_1, ..). v_0 is 1 if a mode of the track is near the
person, v_g is 1 if cue g shows the person; a(dt) = tanh(dt / (2 tau)) is the remaining share of an
image, because misfits persist (`error_model`). A misfit is attributed to the cue or to the track,
whichever is less probably valid given all other cues: (3) is exact. Summed over v_g, it gives minus
the energy -log(p exp(-E_inlier) + (1 - p) exp(-E_outlier)). e_0 is the evidence of the silhouette's
outline for the track, even if the silhouette is invalid: clothes in the colours of the room leave
holes in it, but its remaining parts are at the person.

A mode of a valid track may misplace a part of the body. So for groups of keypoints, e_g is replaced
by log(w exp(e_g) + 1 - w) - log(w + (1 - w) exp(e_g)), of size at most log w / (1 - w), with w =
`PLACED_PROBABILITY`, except at a start, where the pose is given. A silhouette of another object
attracts the modes x, which then explain it. If the modes miss more than a quarter of the keypoints,
a pose x' fitted to keypoints alone (`proposals.whole_poses`) represents the states with an invalid
silhouette:

    a sum_g v_g e_g  <-  log t(x_v) + a sum_g v_g min(e_g(x_v), 0)        x_v: x' where v_s = 0  (4)

A pose that was fitted to a cue is no evidence for that cue. t is the transition density of the pose
from the previous image (`weighting`), used in the image in which x and x' separated.

The misfit of depths is computed at a pose moved to these depths, so depths do not test the track.
Their validity is a separate chain, with the evidence log(P(v_0) exp(e_g) + 1 - P(v_0)).

In an image each cue has the energy p_g E_g, the first-order expansion of the energy above around
E_outlier, with p_g predicted by (1), so that weights and optima use the same sum. A silhouette, a
depth image or a detection is left out if it probably does not show the person. The p_g of groups of
keypoints are conditional on a detector that sees the person.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from hmt_ros.core import elementary, step_chains
from hmt_ros.image.observation import Beliefs
from hmt_ros.image.terms.keypoints import EXCHANGED
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import share_of_time
from hmt_ros.inference.linear_algebra import log_sum_exp, product
from hmt_ros.inference.markov_chain import MarkovChain, update
from hmt_ros.tracking.misfit import KEYPOINTS, OUTLINE, SILHOUETTE, Misfit
from hmt_ros.tracking.settings import (
    MAX_CUE_NATS,
    MISFIT_TIME,
    PLACED_PROBABILITY,
    RATES,
    VALIDITY_COUNT,
    VALIDITY_NATS,
)

VALIDITY_CHAIN = MarkovChain.of_two(*RATES['track and cues'])

DEPTH = 'depth'
# Misfit u at which the evidence about a cue is zero; large for silhouettes, because clothes in the
# colours of the room leave holes.
UNDECIDED_MISFITS = {SILHOUETTE: 0.4, OUTLINE: 0.4, KEYPOINTS: 0.25, DEPTH: 0.15}
# Axes of the joint probability: the track, the detector of keypoints, and the cues.
TRACK, DETECTOR = range(2)
AXES = {SILHOUETTE: slice(2, 3), KEYPOINTS: slice(3, 3 + EXCHANGED.shape[1])}
CHAINS = AXES[KEYPOINTS].stop
# States (2^n, n) of the chains, and validity v in each state: if the detector has failed, its
# groups are invalid.
STATES = np.array(np.unravel_index(np.arange(2**CHAINS), (2,) * CHAINS)).T
# Rates (n, 2) at which each chain recovers and fails, 1/s.
AXIS_RATES = np.tile(RATES['track and cues'], (CHAINS, 1))
AXIS_RATES[DETECTOR] = RATES['detector']
VALID = STATES.astype(np.float64)
VALID[:, AXES[KEYPOINTS]] *= STATES[:, [DETECTOR]]
STATES_WITHOUT_SILHOUETTE = (VALID[:, AXES[SILHOUETTE]] == 0).all(1)


class ByKeypoints(NamedTuple):
    """Pose fitted to keypoints alone, used if the modes miss too many keypoints.

    Attributes:
        keypoints: misfit of this pose to the keypoints.
        gain: log ratio of the transition densities to this pose and to the heaviest mode, nats, in
            the image in which the two separated; reported once, then 0.
    """

    keypoints: Misfit
    gain: float


class Validity:
    """Probabilities that a track and its cues are valid.

    Attributes:
        joint: (2^n,) joint probabilities of the states of track, detector and cues.
    """

    def __init__(self) -> None:
        usual = np.array([MarkovChain.of_two(*rates).usual for rates in AXIS_RATES])
        self._take(usual[np.arange(CHAINS), STATES].prod(1))
        self._depth = VALIDITY_CHAIN.usual

    def _take(self, joint: Array) -> None:
        self.joint = joint
        self._chains = np.asarray(product(joint, VALID), dtype=np.float64)

    @property
    def track(self) -> float:
        """Probability that some mode is near the person."""
        return float(self._chains[TRACK])

    @property
    def cues(self) -> dict[str, Array]:
        """For each cue, the probabilities that its groups show the person.

        Shapes: silhouette (1,), keypoints by group (3,), depths (1,).
        """
        return {name: self._chains[axes] for name, axes in AXES.items()} | {DEPTH: self._depth[1:]}

    def is_trusted(self, cue: str) -> bool:
        """Whether a cue probably shows the person; always true if the track is lost."""
        return self.lost or bool(self.cues[cue].max() >= 0.5)

    @property
    def lost(self) -> bool:
        """Whether the modes are more likely away from the person than near the person."""
        return self.track < 0.5

    @property
    def beliefs(self) -> Beliefs:
        """Factors on the energies of the cues of the next image."""
        cues = self.cues
        silhouette, depth = (float(cues[name][0]) for name in (SILHOUETTE, DEPTH))
        of_person = self.joint * STATES[:, DETECTOR]
        detector = float(of_person.sum())
        groups = product(of_person, VALID[:, AXES[KEYPOINTS]]) / detector
        return Beliefs(silhouette, groups * (detector >= 0.5), depth)

    @property
    def shown(self) -> dict[str, float]:
        """Named probabilities for messages and diagnostics."""
        cues = self.cues
        trunk, arms, legs = (float(p) for p in cues[KEYPOINTS])
        return {
            'silhouette': float(cues[SILHOUETTE][0]),
            'keypoints/trunk': trunk,
            'keypoints/arms': arms,
            'keypoints/legs': legs,
            'depth': float(cues[DEPTH][0]),
            'track': self.track,
        }

    def predict(self, dt: float) -> None:
        """Predicts the probabilities dt seconds ahead, equation (1)."""
        self._depth = VALIDITY_CHAIN.predict(self._depth, dt)
        joint = self.joint.copy()
        step_chains(AXIS_RATES, dt, joint)
        self._take(joint)

    def search(self) -> None:
        """Resets the probability of the track when its modes restart."""
        of_cues = self.joint.reshape(2, -1).sum(TRACK)
        self._take(np.multiply.outer(VALIDITY_CHAIN.usual, of_cues).ravel())

    def update(
        self, misfits: Mapping[str, Misfit], dt: float, alone: ByKeypoints | None = None
    ) -> None:
        """Updates the probabilities from the misfits of the modes to the cues of an image.

        Args:
            misfits: misfits by cue name, including the silhouette's outline.
            dt: time since the previous image, s; infinite at a start.
            alone: pose fitted to keypoints alone; None: not needed.
        """
        share, begun = share_of_time(dt, MISFIT_TIME), bool(np.isfinite(dt))
        says = {
            name: np.clip(share * evidence_of(name, x, begun=begun), -MAX_CUE_NATS, MAX_CUE_NATS)
            for name, x in misfits.items()
        }
        if DEPTH in says:
            (evidence,) = _mixed(self.track, says[DEPTH])
            self._depth = update(self._depth, [0.0, evidence])
        of_track = np.zeros(CHAINS)
        of_track[TRACK] = says.get(OUTLINE, np.zeros(1))[0]
        for name in AXES.keys() & says.keys():
            of_track[AXES[name]] = says[name]
        log_ratios = np.asarray(product(VALID, of_track), dtype=np.float64)
        if alone is not None:
            log_ratios = _divided(of_track, share, alone)
        log_ratios = np.where(VALID[:, TRACK] == 1, log_ratios, 0.0)
        self._take(update(self.joint, log_ratios))

    def update_depths(self, share: float, dt: float) -> None:
        """Updates the validity of depths from their unexplained share; dt as in `update`."""
        self.update({DEPTH: Misfit(np.array([share]), np.array([VALIDITY_COUNT]))}, dt)


def _divided(of_track: Array, share: float, alone: ByKeypoints) -> Array:
    """Log likelihood ratios (2^n,) of the states by (4), if silhouette and keypoints disagree.

    Args:
        of_track: (n,) evidence of each cue at the modes.
        share: factor a(dt) on the evidence of the image.
        alone: pose fitted to keypoints alone.
    """
    own = of_track.copy()
    for axes in AXES.values():
        own[axes] = np.minimum(own[axes], 0.0)
    at_modes = product(VALID, own)
    own[AXES[KEYPOINTS]] = np.minimum(share * evidence_of(KEYPOINTS, alone.keypoints), 0.0)
    by_keypoints = product(VALID, own) + alone.gain
    return np.asarray(np.where(STATES_WITHOUT_SILHOUETTE, by_keypoints, at_modes), dtype=np.float64)


def evidence_of(cue: str, misfit: Misfit, *, begun: bool = True) -> Array:
    """Log likelihood ratios e_g (G,) of valid against invalid groups, nats, equation (2).

    Args:
        cue: name of the cue, or `OUTLINE`.
        misfit: misfit of the groups of the cue.
        begun: whether the track started before this image.
    """
    certainty = np.minimum(misfit.counts / VALIDITY_COUNT, 1.0)
    e = np.asarray(VALIDITY_NATS * certainty * (UNDECIDED_MISFITS[cue] - misfit.shares))
    if cue != KEYPOINTS or not begun:
        return e
    return _mixed(PLACED_PROBABILITY, e) - _mixed(1.0 - PLACED_PROBABILITY, e)


def _mixed(p: float, evidence: Array) -> Array:
    """log(p exp(e) + 1 - p)."""
    both = elementary.log(p) + evidence, np.full_like(evidence, elementary.log1p(-p))
    return np.asarray(log_sum_exp(both, axis=0), dtype=np.float64)
