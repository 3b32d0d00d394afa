"""State of a track other than its modes, and the published estimate.

    existence   whether a person is in view                                    `existence`
    validity    whether modes are at the person, and cues show the person      `validity`
    identity    whether the person in view is the one who was seen last        `SAME_PERSON_CHAIN`

        WAITING or NOBODY  -> (a start)                         ->  TRACKING
        TRACKING           -> (no image locates the person)     ->  LOST
        LOST               -> (found again)                     ->  TRACKING
        TRACKING or LOST   -> (an image shows nobody)           ->  NOBODY
        TRACKING or LOST   -> (not seen for an hour)            ->  WAITING, for anybody

The classes of the modes are Markov chains, too; the modes store them (`hypotheses.Modes`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.image.image_sequence import SeenImage
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.error_model import ERRORS, seconds
from hmt_ros.inference.markov_chain import MarkovChain
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.beginning import Source
from hmt_ros.tracking.existence import Existence, Status
from hmt_ros.tracking.ground import Ground
from hmt_ros.tracking.hypotheses import Modes
from hmt_ros.tracking.laplace_approximation import Likelihood
from hmt_ros.tracking.prediction import Forecaster
from hmt_ros.tracking.settings import RATES
from hmt_ros.tracking.validity import Validity

# Markov chain of whether the person in view is the person seen last.
SAME_PERSON_CHAIN = MarkovChain.of_two(*RATES['same person'])


@dataclass
class TrackState:
    """State of a track, or of a tracker that waits for a person.

    Attributes:
        existence: filter of the probability that a person is in view.
        validity: validity of the modes and of the cues.
        ended: whether a track has ended, so that the next person starts another track.
        last_seen_stamp: timestamp of the last image that showed the person, ns; None: no person is
            known.
        stamp: timestamp of the last image, ns; None: no image yet.
        followed: timestamp of the last image to which the modes were fitted, ns; None: no track.
    """

    existence: Existence = field(default_factory=Existence)
    validity: Validity = field(default_factory=Validity)
    ended: bool = False
    last_seen_stamp: int | None = None
    stamp: int | None = None
    followed: int | None = None

    @property
    def begun(self) -> bool:
        """Whether there is a track."""
        return self.followed is not None

    @property
    def status(self) -> Status:
        """State of the tracker."""
        if not self.begun:
            known = self.existence.nobody or self.last_seen_stamp is not None
            return Status.NOBODY if self.ended and known else Status.WAITING
        found = self.existence.somebody and not self.validity.lost
        return Status.TRACKING if found else Status.LOST

    @property
    def probability(self) -> float:
        """Probability that a person is in view; NaN without any evidence."""
        known = self.begun or self.existence.last_evidence
        return self.existence.probability if known else math.nan

    @property
    def nobody_shown(self) -> bool:
        """Whether the last image is evidence that nobody is in view; a covered lens is not."""
        return self.ended and self.existence.nobody

    def age(self, stamp: int) -> float:
        """Time since the last image to which the modes were fitted, s; 0 without a track."""
        return 0.0 if self.followed is None else seconds(stamp - self.followed)

    def is_somebody_else(self, stamp: int) -> bool:
        """Whether a person in view at a timestamp, ns, is probably not the person seen last."""
        if self.last_seen_stamp is None:
            return False
        return bool(SAME_PERSON_CHAIN.closed(1.0, seconds(stamp - self.last_seen_stamp)) < 0.5)

    def reason(self, scene: str, misfit: float) -> str:
        """Text that explains why no person is tracked; '' if none is needed.

        Args:
            scene: text that explains why there are no silhouettes.
            misfit: share of the last image that no mode explains.
        """
        status, existence = self.status, self.existence
        if status is Status.WAITING:
            return 'nobody has been seen so far' if existence.last_evidence else scene
        if status is Status.NOBODY and not self.nobody_shown:
            return 'the image shows neither somebody nor that nobody is there'
        if status is not Status.LOST:
            return ''
        if not existence.somebody:
            return (
                'no image says where the person is, who is in view with a probability of '
                f'{existence.probability:.0%}'
            )
        return f'no mode explains {misfit:.0%} of what is seen'


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimate of a tracker after an image.

    Attributes:
        status: state of the tracker.
        reason: text that explains why no person is tracked; '' if none is needed.
        existence_probability: probability that a person is in view, given all images so far; NaN
            without any evidence.
        nobody_shown: whether the last image is evidence that nobody is in view; a covered lens is
            not.
        started_from: input from which the track started; None before the first track.
        body: body with the present estimate of lengths and flesh.
        modes: propagated modes of the track, heaviest first; empty without a track.
        published: modes of the published posterior, with unseen limbs spread over usual postures.
        point_estimate: (d,) pose whose joints have the least expected distance from the person's;
            empty without a track.
        likelihood: likelihood of the last image in which the person was tracked.
        shown: evidence from the last image, with each cue weighted by its validity; None if the
            modes were not fitted to the image.
        foreseen: whether a prediction is published, because the last image did not show the person.
        misfit: share of the last image that no mode explains.
        evaluations: number of evaluations of the likelihood in the last image.
        validity: probabilities that the track and each cue of the images are valid.
        contacts: probabilities that 'left_foot' and 'right_foot' of the heaviest mode rest on the
            floor. Empty if there is no track, the body has no feet, the ground terms are off, or
            the motion of the camera is unknown. With a background image the camera is fixed;
            otherwise `Tracker.set_camera` gives its motion.
        ground: known or estimated gravity and floor.
        vertical: (3,) unit vector against gravity, camera frame, given or shown by the scene; None
            if unknown, or only guessed from the track.
        gravity_contradicted: whether scene or person contradict the given gravity, which is used
            anyway.
        gravity_reversed: whether the given gravity is used with the opposite sign, because it has
            the sign of an accelerometer.
        motion: value of the setting `motion`.
        stamp_ns: timestamp of the last image to which the modes were fitted; None: no track.
    """

    status: Status
    reason: str
    existence_probability: float
    nobody_shown: bool
    started_from: Source | None
    body: Body
    modes: Modes
    published: Modes
    point_estimate: Array
    likelihood: Likelihood
    shown: SeenImage | None
    foreseen: bool
    misfit: float
    evaluations: int
    validity: Validity
    contacts: Mapping[str, float]
    ground: Ground
    vertical: Array | None
    gravity_contradicted: bool
    gravity_reversed: bool
    motion: str
    stamp_ns: int | None

    @property
    def posterior(self) -> GaussianMixture:
        """Posterior over poses, without components if there is no track."""
        return self.published.mixture

    @property
    def velocities(self) -> Array | None:
        """Velocities (K, d) of the published modes, per second; None if unknown.

        Velocities are unknown in the first image of a track, and with a random walk.
        """
        velocities = self.published.velocities
        return velocities if velocities.any() else None

    @property
    def origins(self) -> Array:
        """Probabilities (K, M) that component k of the posterior continues previous component m.

        M is the number of components of the previous image, or 0 if a track starts or restarts; see
        `LaggedWeights`.
        """
        return np.eye(len(self.published)) if self.foreseen else self.published.origins

    @property
    def forecaster(self) -> Forecaster:
        """Predicts the track from the last image to which the modes were fitted.

        Raises:
            ValueError: there is no track.
        """
        if self.stamp_ns is None:
            raise ValueError('there is no track to predict')
        return Forecaster(self.published, self.body, self.motion, self.stamp_ns)


def no_likelihood(dimension: int) -> Likelihood:
    """Empty likelihood over poses of `dimension` variables, before the first image."""
    square = np.zeros((dimension, dimension))
    nothing = GaussianMixture(np.empty(0), np.empty((0, dimension)), square[None][:0])
    none, nobody = np.empty(0), np.empty(0, dtype=np.intp)
    return Likelihood(
        nothing, none, ERRORS['image'], square, nobody, none, nobody, square[:0, :0], nobody, None
    )
