"""Which way a person faces: both ways are followed until the images have decided.

    log p(way | images) = log_evidence(way) - log sum,      given up below -25 nats

A silhouette does not tell a pose from its reversal in depth (`body.mirror`), and neither do the
first images of a track: who comes may as well go. Knees, elbows and feet give it away within a
second or two, as they move. So a track that starts from silhouettes alone is followed twice, by a
filter for either way; the evidence of the filters weighs the two.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.mirror import left_directions
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.camera_motion import CameraMotion
from hmt_ros.tracking.filter import MixtureFilter
from hmt_ros.tracking.ground import GroundEstimator
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.proposals import PosePrediction
from hmt_ros.tracking.settings import TrackerSettings
from hmt_ros.tracking.weighting import log_shares, normalised, weigh

# One of two ways to face is given up when it is less probable by this, nats.
DECIDED = 25.0


class Track:
    """One person, followed by one filter, or by two while it is open which way the person faces.

    Args:
        body: model of the person.
        camera: that sees the person.
        settings: how.
        seed: of all randomness.
        extra: further energy terms.
        ground: gravity and floor; None: nothing is made of them.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera,
        settings: TrackerSettings,
        seed: int,
        extra: tuple[FrameTerm, ...] = (),
        ground: GroundEstimator | None = None,
    ) -> None:
        self.settings = settings
        self._filters = [MixtureFilter(body, camera, settings, seed, extra, ground)]
        self._undecided_until = 0

    @property
    def begun(self) -> bool:
        """Whether there are modes."""
        return self._first.begun

    @property
    def body(self) -> Body:
        """The person, with what has been estimated of lengths and flesh."""
        return self._first.body

    @property
    def lost(self) -> bool:
        """Whether the last images were explained too badly."""
        return self._first.lost

    @property
    def believes_silhouettes(self) -> bool:
        """Whether silhouettes have shown the person so far."""
        return self._first.recall.believed

    @property
    def misfit(self) -> float:
        """Share of the last image that no mode explains."""
        return self._first.misfit

    @property
    def contacts(self) -> dict[str, float]:
        """Probability that the heaviest mode rests on a foot, by foot; empty: unknown."""
        return self._first.contacts.by_foot()

    @property
    def evaluations(self) -> int:
        """Number of evaluations of the likelihood in the last image."""
        return sum(one.evaluations for one in self._filters)

    @property
    def modes(self) -> Modes:
        """The present modes; those of both ways to face while that is not decided.

        Raises:
            ValueError: there is no track.
        """
        modes = self._first.modes
        return modes if len(self._filters) == 1 else _joined(*self._filters)

    def likelihood_mixture(self, observation: Observation) -> tuple[GaussianMixture, Array]:
        """The modes of the likelihood alone, and its log at their means; see `likelihood_modes`."""
        return self._first.likelihood_mixture(self.modes, observation)

    def begin(
        self,
        body: Body,
        start: GaussianMixture | Array,
        observation: Observation,
        stamp: int,
        *,
        both_ways: bool,
        clicked: Keypoints | None = None,
    ) -> None:
        """Starts the track.

        Args:
            body: of the person.
            start: expected poses, or poses (N, d) that all count the same.
            observation: of the first image.
            stamp: of the image, ns.
            both_ways: whether the way to face is open.
            clicked: keypoints that the start is fitted to, in place of those of the image.
        """
        self._forget_evaluations()
        if isinstance(start, GaussianMixture):
            poses = start.means
            with np.errstate(divide='ignore'):
                log_weights = np.log(start.normalised().weights)
            precisions = np.asarray(np.linalg.inv(start.covariances), dtype=np.float64)
        else:
            poses, log_weights = start, np.zeros(len(start))
            precisions = np.zeros((len(poses), body.dimension, body.dimension))
        seen = observation if clicked is None else replace(observation, keypoints=clicked)
        del self._filters[1:]
        solved = self._first.begin(body, poses, log_weights, precisions, seen)
        if both_ways:
            self._follow_both_ways(solved, log_weights, observation, stamp)
        self._conclude(observation, stamp)

    def begin_anew(
        self, poses: Array, observation: Observation, stamp: int, *, both_ways: bool
    ) -> None:
        """Starts a lost track anew from poses (N, d) and the present modes; see `begin`."""
        self._forget_evaluations()
        poses = np.concatenate([self._first.modes.poses, poses])
        del self._filters[1:]
        solved = self._first.begin_anew(poses, observation)
        if both_ways:
            self._follow_both_ways(solved, np.zeros(len(poses)), observation, stamp)
        self._conclude(observation, stamp)

    def carry(self, motion: CameraMotion) -> None:
        """Takes the track into the camera frame of the next image."""
        for one in self._filters:
            one.carry(motion)

    def propagate(
        self, observation: Observation, stamp: int, dt: float, prediction: PosePrediction | None
    ) -> None:
        """Moves the track on to the next image.

        Args:
            observation: of the image.
            stamp: of the image, ns.
            dt: since the last image, s.
            prediction: from an external predictor, if any.
        """
        self._forget_evaluations()
        for one in self._filters:
            expected = None if prediction is None else prediction.seen_as(one.body)
            if prediction is not None and len(self._filters) > 1:
                # Neither is offered the way that the other faces.
                both = prediction.both_ways(one.body)
                own = both[faces_like(one.body, both.means, one.modes.poses[0])]
                expected = own.normalised() if len(own) else None
            one.propagate(observation, dt, expected)
        self._conclude(observation, stamp)

    @property
    def _first(self) -> MixtureFilter:
        return self._filters[0]

    def _forget_evaluations(self) -> None:
        for one in self._filters:
            one.evaluations = 0

    def _conclude(self, observation: Observation, stamp: int) -> None:
        for one in self._filters:
            one.assess(observation)
        if len(self._filters) > 1:
            self._decide_facing(observation, stamp)

    def _follow_both_ways(
        self, solved: Minimum, log_weights: Array, observation: Observation, stamp: int
    ) -> None:
        """Follows those that face like the best, and beside them those that face otherwise."""
        s, first = self.settings, self._first
        if s.facing_trial == 0:
            return
        usable = np.flatnonzero(np.isfinite(solved.value))
        weights = weigh(log_weights[usable], solved.value[usable], first.beta)
        best = usable[np.argmax(weights)]
        alike = faces_like(first.body, solved.x, solved.x[best])[usable]
        if alike.all():
            return
        self._filters.append(first.twin())
        for one, rows in zip(self._filters, (usable[alike], usable[~alike]), strict=True):
            one.hold(solved[rows], log_weights[rows], observation)
        self._undecided_until = stamp + round(s.facing_trial * 1e9)

    def _decide_facing(self, observation: Observation, stamp: int) -> None:
        """Gives one way to face up where the images speak against it.

        When time is over and they do not, both become one mixture.
        """
        mine, other = self._filters
        ahead = mine.log_evidence - other.log_evidence
        decided = abs(ahead) >= DECIDED or mine.lost != other.lost
        if not decided and stamp < self._undecided_until:
            return
        better, worse = mine, other
        if mine.lost > other.lost or (mine.lost == other.lost and ahead < 0):
            better, worse = other, mine
        if not decided:
            better.absorb(_joined(better, worse), observation)
        self._filters = [better]


def _joined(a: MixtureFilter, b: MixtureFilter) -> Modes:
    """The heaviest modes of two filters, without textures."""
    shares = log_shares([a.log_evidence, b.log_evidence])
    first, second = (
        replace(x.modes, log_weights=x.modes.log_weights + share, textures=None)
        for x, share in zip((a, b), shares, strict=True)
    )
    both = first.joined(second)
    heaviest = both[np.argsort(-both.log_weights, kind='stable')[: a.settings.max_hypotheses]]
    return replace(heaviest, log_weights=normalised(heaviest.log_weights))


def faces_like(body: Body, poses: Array, pose: Array) -> NDArray[np.bool_]:
    """Which of poses (N, d) face the same way as a pose (d,), within a right angle."""
    result: NDArray[np.bool_] = (
        left_directions(body, poses) @ left_directions(body, pose[None])[0] >= 0
    )
    return result
