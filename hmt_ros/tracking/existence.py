"""Existence: the probability that a person is in view.

    r = p(somebody is in view | images so far)

    predict   r <- s(dt) r + b(dt) (1 - r)                     a chain of two states (`MarkovChain`)
    update    logit r <- logit r + sum_g a_g(dt) llr_g         a_g(dt) = tanh(dt / (2 tau_g))

This is the existence probability of integrated probabilistic data association (Musicki, Evans and
Stankovic, "Integrated probabilistic data association", 1994) and of the Bernoulli filter (Ristic et
al., "A tutorial on Bernoulli filters", 2013, equations 28 and 56), with rates per second in place
of probabilities per scan. llr_g is the log likelihood ratio of a person against nobody in view, for
cue g in the whole image, and a_g discounts it, because the errors of a cue persist (`error_model`).

    silhouette   m = max(share of the model on it / usual share, area of its largest piece that has
                 the shape of a person / usual area), in the whole image
    detector     sum of the confidences of the keypoints
    predictor    whether it predicts a person; if so, used only without a silhouette
    motion       whether the model moved, and nothing else; only if there is no other cue
    colours      whether the person's colours are anywhere; only if nothing else shows a person, and
                 against a person only in the scene where they were learned

Before a track starts, keypoints of unchanged images are used once: a detector that confuses the
foot of a table with a person does so in every such image. People always move a little.

If nothing has moved, a person who was in view is still there, so the prediction is skipped.

An image that has mostly changed is no evidence: a covered lens, a flash, noise. If the camera has
moved, missing colours are no evidence against a person, because they may have belonged to an
object. If other people hide the person, only evidence for the person is used. So only an image of
the empty place ends a track: without such an image r tends to b / (b + l), far above
`ABSENT_PROBABILITY`, with the rates b of entering and l of leaving the view.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import Enum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.core import elementary
from hmt_ros.image.keypoint_evidence import keypoint_evidence, suffices
from hmt_ros.image.person_colours import Motion
from hmt_ros.image.still_picture import StillPicture
from hmt_ros.inference.error_model import seconds, share_of_time
from hmt_ros.inference.markov_chain import MarkovChain, of_log_odds, update
from hmt_ros.tracking.appearance import Appearance
from hmt_ros.tracking.observer import View
from hmt_ros.tracking.settings import (
    ABSENT_PROBABILITY,
    EXISTENCE_CUES,
    MAJORITY_FRACTION,
    PART_FRACTION,
    PRESENT_PROBABILITY,
    RATES,
)

EXISTENCE_CHAIN = MarkovChain.of_two(*RATES['existence'])
NO_MOTION = Motion(moved=False, still=False)


class Status(Enum):
    """State of the tracker."""

    WAITING = 'waiting'  # waits for the subject's image, or for a person
    TRACKING = 'tracking'
    LOST = 'lost'
    NOBODY = 'nobody'  # nobody is in view


class Cue(NamedTuple):
    """Weight of a cue.

    Attributes:
        nats: largest log likelihood ratio of a person against nobody in view.
        tau: correlation time of the errors of the cue, s.
    """

    nats: float
    tau: float


CLEAR_CUE, DOUBTFUL_CUE = (Cue(*EXISTENCE_CUES[name]) for name in ('clear', 'doubtful'))

# Probabilities of existence: before the first image (as after a clear image without a person), and
# at a given start (as after a clear image of a person).
INITIAL_PROBABILITY, GIVEN_PROBABILITY = of_log_odds([-CLEAR_CUE.nats, CLEAR_CUE.nats])[
    :, 1
].tolist()


class Sighting(NamedTuple):
    """Evidence of all cues in an image for or against a person.

    Attributes:
        log_ratios: log likelihood ratio of each cue, nats; positive for a person in view.
        seen: whether the person can be tracked in the image: a cue shows a person, or the image is
            usable and no cue is evidence against a person.
        blank: whether modes cannot be fitted to the image, because other people hide most of the
            person, or the silhouette shows nobody.
        hidden: whether other people hide most of the person.
        elsewhere: whether the person must be searched for, because the image shows a person away
            from all modes, or too long after the last sighting for the modes to be useful.
        still_in_view: whether the image shows the person, or is unchanged since an image that
            showed the person.
    """

    log_ratios: Mapping[str, float] = MappingProxyType({})
    seen: bool = False
    blank: bool = False
    hidden: bool = False
    elsewhere: bool = False
    still_in_view: bool = True

    @property
    def llr(self) -> float:
        """Log likelihood ratio of all cues, nats; positive for a person in view."""
        return sum(self.log_ratios.values())


class Existence:
    """Filter of the probability that a person is in view.

    Args:
        probability: probability before the first image.

    Attributes:
        last: evidence from the last image.
        last_evidence: timestamp of the last evidence of each cue, ns.
        appearance: appearance of the person.
    """

    def __init__(self, probability: float = INITIAL_PROBABILITY) -> None:
        self._p = np.array([1.0 - probability, probability])
        self.last = Sighting()
        self.last_evidence: dict[str, int] = {}
        self.appearance = Appearance()
        self._stamps: tuple[int, int] | None = None  # timestamps of first and last image, ns
        self._still = StillPicture()

    @property
    def probability(self) -> float:
        """Probability that a person is in view, given all images so far."""
        return float(self._p[1])

    @property
    def log_odds(self) -> float:
        """Log odds of a person in view, nats."""
        nobody, somebody = elementary.log(np.maximum(self._p, 1e-300))
        return float(somebody - nobody)

    @property
    def somebody(self) -> bool:
        """Whether a person is in view."""
        return self.probability >= PRESENT_PROBABILITY

    @property
    def nobody(self) -> bool:
        """Whether nobody is probably in view, and the last image was evidence for this."""
        return self.probability < ABSENT_PROBABILITY and self.last.llr < 0.0

    def update(self, view: View, body: Body, *, waiting: bool = False) -> None:
        """Updates the probability from the next image.

        Args:
            view: view of the image, later than the previous one.
            body: body of the person.
            waiting: whether no track has started yet.
        """
        stamp = view.stamp
        # Motion is used only if there is no other cue.
        alone = view.anywhere is None and view.keypoints is None and not waiting
        motion = self.appearance.motion(view) if alone else NO_MOTION
        still = motion.still and self.last.still_in_view
        if self._stamps is not None and not still:
            self._p = EXISTENCE_CHAIN.predict(self._p, seconds(stamp - self._stamps[1]))
        # A person who has not been seen for long may have left.
        forgotten = bool(
            EXISTENCE_CHAIN.closed(1.0, self.appearance.unseen(stamp)) < MAJORITY_FRACTION
        )
        hidden = self.appearance.uncovered_share(view.others) < 1.0 - MAJORITY_FRACTION
        cues, usable, apart = self._cues(view, body)
        denied = min((value * cue.nats for value, cue in cues.values()), default=0.0)
        if motion.moved and denied > -0.5 * DOUBTFUL_CUE.nats:
            cues['motion'] = 1.0, DOUBTFUL_CUE
        detected = cues.get('detector', (0.0, CLEAR_CUE))[0] > 0.0
        keypoints = view.keypoints if waiting and detected else None
        if keypoints is not None and self._still.shows_again(view.image, keypoints):
            del cues['detector']
        if hidden:
            cues = {name: cue for name, cue in cues.items() if cue[0] > 0.0}
        log_ratios = {
            name: value * cue.nats * share_of_time(self._time_since(name, stamp), cue.tau)
            for name, (value, cue) in cues.items()
        }
        values = [value for value, _ in cues.values()]
        shown = any(value > 0.0 for value in values)
        seen = shown or (usable and not any(value < 0.0 for value in values))
        self.last = Sighting(
            log_ratios,
            seen=seen,
            blank=not seen and (hidden or view.silhouette is not None),
            hidden=hidden,
            elsewhere=shown and (forgotten or apart),
            still_in_view=shown or still,
        )
        self._p = update(self._p, [0.0, self.last.llr])
        self.last_evidence |= dict.fromkeys(cues, stamp)
        self._stamps = stamp if self._stamps is None else self._stamps[0], stamp

    def _cues(self, view: View, body: Body) -> tuple[dict[str, tuple[float, Cue]], bool, bool]:
        """Evaluates the cues, each from -1 (nobody) to 1 (a person).

        Returns:
            Value and weight of each informative cue; whether the image is usable, always true
            without silhouettes; whether the image shows a person away from the model.
        """
        cues, apart = {}, False
        usable = view.anywhere is None
        found = self.appearance.silhouetted(view, view.stamp)
        if found is not None:
            usable = True
            part = PART_FRACTION if found.cut and found.by_place <= 0.0 < found.by_area else 1.0
            cues['silhouette'] = part * found.evidence, CLEAR_CUE
            apart = found.by_place < 0.0 < found.by_area
        if view.keypoints is not None:
            value = keypoint_evidence(view.keypoints, body)
            if value > 0.0:
                part = 1.0 if suffices(view.keypoints, body) else PART_FRACTION
                cues['detector'] = part * value, CLEAR_CUE
                apart = apart or self.appearance.is_apart(view, view.stamp)
            else:
                cues['detector'] = value, DOUBTFUL_CUE
        if view.predicted is not None and (not view.predicted or view.anywhere is None):
            cues['predictor'] = (1.0, CLEAR_CUE) if view.predicted else (-1.0, DOUBTFUL_CUE)
        if found is None and not any(value > 0.0 for value, _ in cues.values()):
            colours = self.appearance.colour_evidence(view)
            # If most of the image has changed, the colours may have changed, too.
            if colours is not None and (usable or colours[0]):
                there, part = colours
                nats = part * DOUBTFUL_CUE.nats
                cues['colours'] = 1.0 if there else -1.0, DOUBTFUL_CUE._replace(nats=nats)
        return cues, usable, apart

    def _time_since(self, cue: str, stamp: int) -> float:
        """Time since the last evidence from a cue, s; infinite in the first image."""
        if self._stamps is None:
            return math.inf
        return seconds(stamp - self.last_evidence.get(cue, self._stamps[0]))
