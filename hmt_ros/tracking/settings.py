"""How poses are tracked: the settings of a tracker, and the numbers of its model.

Users choose the settings; the other numbers are constants. Each has its unit and its source:
`Physical` follows from people or from sensors, `Chosen` was set by hand, by tracked clips. Numbers
of a concept of a lower layer are defined there: the person in `body`, silhouettes, colours and
keypoints in `image`, errors of cues in `inference.error_model`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

import numpy as np

from hmt_ros.body.ground_terms import GroundSettings
from hmt_ros.image.likelihood import LikelihoodSettings

MOTIONS = ('learned', 'random_walk')

# --- Search

# Number of evaluations per image above which more hardly help. Chosen by accuracy on tracked clips.
ACCURATE_BUDGET = 400
# Ratio of the squared motion of the heaviest mode to the expected one above which an image is
# surprising: the motion prior is wider than most motions. Chosen.
SURPRISING_RATIO = 0.3
# Factor on the budget of a surprising image. Chosen.
SURPRISING_FACTOR = 4
# Distance of joints up to which two trunks, and two configurations of a limb, are the same, m.
# Chosen.
SAME_TRUNK_DISTANCE, SAME_LIMB_DISTANCE = 0.06, 0.08
# Degrees of freedom of the Student prior that keeps a limb near its prediction. Chosen.
LIMB_TAILS = 4.0
# Factor on the deviations of the body's prior where configurations of a limb are drawn from it.
# Chosen.
PRIOR_STRETCH = 1.3
# Maximum distance of a joint in the selection of hypotheses, m. Chosen.
MAX_JOINT_DISTANCE = 0.3

# --- Weights and modes

# Mean squared distance by which joints leave their prediction, m^2/s, and degrees of freedom of its
# Student tails: modes jitter, and limbs are found in unexpected places. Chosen.
TRANSITION_SPREAD, TRANSITION_TAILS = 0.01, 2.0
# c of the probability exp(-c) below which all continuations of a mode lie if it ends, nats. Chosen.
END_NATS = 5.0
# Largest shift of a mode of the posterior to that of the likelihood, in standard deviations of the
# posterior: the likelihood alone may be flat. Chosen.
MAX_MODE_SHIFT = 5.0
# Number of standard deviations above which a measurement is unexplained or a value implausible.
# Chosen.
GATE_SIGMAS = 4.0

# --- Start of a track

# Standard deviation of a length of the person measured with a tape, m. Physical.
MEASURED_SIGMA = 0.01
# Standard deviation of the place of a person in a given box, as a fraction of the distance. Chosen.
BOX_SIGMA = 0.15
# Number of headings from which a pose is fitted. Chosen.
HEADINGS = 8
# Maximum number of poses that a track starts from. Chosen.
MAX_STARTS = 96
# Distance of some joint from which two starts are distinct, m. Chosen.
START_DISTANCE = 0.03
# Time in which a person hardly moves, s. Chosen.
SAME_MOMENT = 0.2

# --- Shape of the person

# Largest change of the shape by one image, and in total, in standard deviations over people.
# Chosen.
MAX_SHAPE_STEP, MAX_SHAPE_CHANGE = 0.5, 3.0
# Change of the estimate above which the body, and all that depends on it, is rebuilt, in standard
# deviations over people (2 mm of a length). Chosen.
REBUILDING_CHANGE = 0.1
# Largest change of an angle that adapts to a change of the shape, rad. Chosen.
MAX_ANGLE_SHIFT = 0.2

# --- Gravity and floor

# Default standard deviation of a given direction of gravity, rad, by the mounting of a camera.
# Physical.
GIVEN_UP_SIGMA = np.radians(2.0)
# Standard deviation of gravity from the y axis of an image for handheld cameras, rad. Chosen.
UP_SIGMA = np.radians(15.0)
# Standard deviation of the axis of a standing body from the vertical, rad, twice as large along the
# line of sight; lower bound of that of the vertical. Chosen.
AXIS_SIGMA = np.radians(4.0)
# Duration of an error of the vertical, by the axis of a body and by the lines of the scene, s.
# Chosen.
VERTICAL_TIME = 1.0
# Drift of the vertical, rad/sqrt(s). Chosen.
UP_DRIFT = np.radians(1.0)
# Time window of the lowest sole, s, and the quantile in it that is the floor. Chosen.
LEVEL_TIME, LEVEL_QUANTILE = 2.0, 0.75
# Standard deviation of the floor from that quantile, m, twice as large by one image. Chosen.
LEVEL_SIGMA = 0.04
# Change of a given direction of gravity above the noise of a sensor, so that the camera turns, rad.
# Physical.
TURN_NOISE = 0.003
# Number of images with a person head down, weighted by the cosine between trunk and vertical, after
# which a given vertical that points up in the image is reversed: handstands are shorter. Chosen.
HEAD_DOWN_IMAGES = 30.0
# Prior log odds for the given vertical of a nearly upright camera, nats, and bound on the evidence
# of a lying person against it: some people do lie. Chosen.
RIGHT_VERTICAL_NATS = 3.5
# Largest log odds by one look at the lines of the scene, nats. Chosen.
LOOK_NATS = 2.0
# Concentration about the vertical of the axes of people who do not lie. Chosen.
UPRIGHT_CONCENTRATION = 8.0

# --- Camera and appearance

# Maximum time for which the last known motion of the camera is extrapolated, s. Chosen.
MAX_EXTRAPOLATION_TIME = 0.5
# Fraction of an image, or of a person, above which it is most of it.
MAJORITY = 0.5
# Fraction of the usual value at which a silhouette is no evidence; 0 is full evidence of absence,
# twice this fraction full evidence of presence. Chosen.
UNDECIDED_FRACTION = 0.25


@dataclass(frozen=True)
class LimbSearchSettings:
    """How limbs are searched.

    Attributes:
        samples: Maximum number of samples that a limb draws; a third from the mode, a third from it
            stretched, a third from the body's prior.
        stretch: Factor on the deviations of the second third.
        refined: Maximum number of best samples that are refined.
        iterations: Number of Newton steps of the refinement.
    """

    samples: int = 48
    stretch: float = 2.5
    refined: int = 3
    iterations: int = 6


@dataclass(frozen=True)
class EvaluationPlan:
    """Sizes of the search in an image, in evaluations, so that results do not depend on speed.

        budget B    predictions descend    limbs and trunks are rated    candidates descend
        share       about B / 8            at most 2 B / 3                about B / 5

    If limbs are searched for as well, at most 2 B / 5 are rated. The rest is for covariances and
    shape of the modes and for the likelihood alone. Settings bound each part; a smaller budget
    reduces all parts.

    Attributes:
        hypotheses: maximum number of modes that are kept, K.
        candidates: maximum number of hypotheses that are fully optimised.
        iterations: number of Newton steps on the predictions, and on the candidates.
        groups: maximum number of searched groups of modes, each with a common trunk.
        rated: maximum number of poses that are rated, all groups together, if limbs are searched
            for.
        rated_alone: the same without limb search.
        alternatives: maximum number of configurations of a limb.
        combinations: maximum number of combinations on each trunk.
        searched_chains: number of limbs searched in each group.
        samples, refined: numbers of samples of a limb, and of the best ones that are refined.
        surprising: whether the image is surprising.
    """

    hypotheses: int
    candidates: int
    iterations: int
    groups: int
    rated: int
    rated_alone: int
    alternatives: int
    combinations: int
    searched_chains: int
    samples: int
    refined: int
    surprising: bool


@dataclass(frozen=True)
class TrackerSettings:
    """How poses are tracked.

    Attributes:
        evaluation_budget: Number of evaluations of poses that an image may take, about: 400 is
            accurate, 300 is nearly so, and with fewer quality falls step by step.
        max_hypotheses: Maximum number of modes that are kept, K.
        hypothesis_merge_distance: Mean distance of the joints below which two modes are merged, m.
        proposals: Proposal distribution: 'kjs' (kinematic jumps and covariance-scaled samples),
            'css' (covariance-scaled samples alone) or 'ss' (spherical samples alone); the names
            are those in `tracking.proposals`.
        candidates: Maximum number of hypotheses that are fully optimised in an image; as many as
            modes in any case.
        combinations: Maximum number of combinations of limb configurations on each trunk.
        alternatives: Maximum number of configurations of a limb that are rated.
        samples: Number of samples drawn in an image by the proposals 'css' and 'ss'.
        sample_scale: Scale of the proposal covariance; 0 selects Cauchy tails.
        searched_chains: Maximum number of limbs searched on a trunk, chosen at random.
        iterations: Maximum number of Newton steps on the predictions, and on the candidates.
        motion: Motion prior: 'learned', where the body ships with one, or 'random_walk' at the
            rates of the body.
        flow_weight: Number of independent measurements that the optical flow counts for where it
            corrects predictions; 0 switches it off.
        least_log_weight: Smallest log weight of a mode that is kept, nats.
        estimate_shape: Whether lengths and flesh of the person are estimated while the track lasts.
        lifter: Experts that tell from the keypoints of the last images how deep the joints are:
            'keypoints', which ships, or a file that 'learn lifter' wrote; if empty, keypoints count
            by themselves.
        threads: Number of threads that share the poses of an image; 0 takes one a core, 8 at most,
            and leaves one core to others.
            Results do not depend on it.
        likelihood: settings of the likelihood.
        search: settings of the search of limbs.
        ground: settings of what is known of gravity and floor.
    """

    evaluation_budget: int = ACCURATE_BUDGET
    max_hypotheses: int = 8
    hypothesis_merge_distance: float = 0.02
    proposals: str = 'kjs'
    candidates: int = 16
    combinations: int = 96
    alternatives: int = 10
    samples: int = 256
    sample_scale: float = 2.0
    searched_chains: int = 4
    iterations: int = 6
    motion: str = 'learned'
    flow_weight: float = 5.0
    least_log_weight: float = -14.0
    estimate_shape: bool = True
    lifter: str = 'keypoints'
    threads: int = 0
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    search: LimbSearchSettings = field(default_factory=LimbSearchSettings)
    ground: GroundSettings = field(default_factory=GroundSettings)

    def __post_init__(self) -> None:
        if self.motion not in MOTIONS:
            raise ValueError(f'motion must be one of {MOTIONS}, saw {self.motion!r}')
        for name in (
            'evaluation_budget',
            'max_hypotheses',
            'candidates',
            'combinations',
            'alternatives',
            'samples',
            'iterations',
        ):
            if not getattr(self, name) >= 1:
                raise ValueError(f'{name} must be at least 1, saw {getattr(self, name)}')
        if self.threads < 0:
            raise ValueError(f'threads must be at least 0, saw {self.threads}')
        if not self.flow_weight >= 0:
            raise ValueError(f'flow_weight must be at least 0, saw {self.flow_weight}')

    @cached_property
    def plan(self) -> EvaluationPlan:
        """Allocation of the evaluations of an image."""
        return self._planned(self.evaluation_budget)

    @cached_property
    def thorough_plan(self) -> EvaluationPlan:
        """The plan for a surprising image, with the same number of modes."""
        plan = self._planned(SURPRISING_FACTOR * self.evaluation_budget)
        return replace(plan, hypotheses=self.plan.hypotheses, surprising=True)

    def _planned(self, budget: int) -> EvaluationPlan:
        """The plan within an evaluation budget and the bounds of the settings."""
        hypotheses = min(self.max_hypotheses, max(budget // 25, 1))
        limbs, eighth = budget // 65, max(budget // 8, 1)
        searched = max(round(budget / ACCURATE_BUDGET), 1)
        return EvaluationPlan(
            hypotheses=hypotheses,
            candidates=max(min(self.candidates, budget // 40), hypotheses),
            iterations=min(self.iterations, max(budget // 60, 1)),
            groups=min(3, max(limbs, 1)),
            rated=2 * budget // 5,
            rated_alone=2 * budget // 3,
            alternatives=min(self.alternatives, max(limbs, 2)),
            combinations=min(self.combinations, eighth),
            # With less than a quarter of the accurate budget no limb is searched.
            searched_chains=min(self.searched_chains, searched)
            if SURPRISING_FACTOR * budget >= ACCURATE_BUDGET
            else 0,
            samples=min(self.search.samples, eighth),
            refined=min(self.search.refined, max(limbs // 2, 1)),
            surprising=False,
        )


# --- Beliefs of a track

# Rates at which the second state of two-state chains begins and ends, 1/s.
RATES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        # A person enters an empty view, and leaves it. Chosen.
        'existence': (0.1, 0.2),
        # Unseen, another person replaces the last one once in an hour. Chosen.
        'same person': (0.0, 1.0 / 3600.0),
        # A track or a cue recovers, and fails. Chosen.
        'track and cues': (1.0, 0.05),
        # A detector as a whole returns to the person, and turns to another. Chosen.
        'detector': (1.0, 0.02),
    }
)
# Largest log likelihood ratio of somebody against nobody in an image, nats, and duration of its
# errors, s. A clear image is wrong in 1 of 3,000 cases, by a persistent cause outside the model. A
# detector misses a badly visible person in about 1 of 100 images, for longer. Chosen.
EXISTENCE_CUES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {'clear': (8.0, 0.2), 'doubtful': (5.0, 0.25)}
)
# Probabilities of existence above which somebody is present, so that a new track may start, and
# below which nobody is, if the image is evidence of that. Between them it is undecided. Chosen.
PRESENT_PROBABILITY, ABSENT_PROBABILITY = 0.85, 0.03
# Weight of the cue of a silhouette that a side of the image may cut, and of keypoints of a part of
# a person. Chosen.
PART_FRACTION = 0.6
# Difference in evidence between a wholly explained cue and an unexplained one, nats, and the number
# of measurements that suffices for it: neighbours have common errors. Chosen.
VALIDITY_NATS, VALIDITY_COUNT = 16.0, 4
# Duration of misfits of the modes to a cue, s. Chosen.
MISFIT_TIME = 0.1
# Maximum evidence of one image about a cue, nats: it may be wrong in unforeseen ways. Chosen.
MAX_CUE_NATS = 3.5
# Probability that a mode has the right place of a part of the body: limbs lag behind, and are hard
# to see in front of the trunk. Chosen.
PLACED_PROBABILITY = 0.8
# Probability that the evidence of an image for a facing direction is about the person. Chosen.
FACING_VALID = 0.9
# Largest log odds of a facing direction, nats, also of the only one that a start has. Chosen.
MAX_FACING_NATS = 10.0
# Least probability of an exchange of sides by a detector. Chosen.
LEAST_EXCHANGE = 1e-6
# Difference in log weight to the heaviest mode up to which a mode is likely, nats. Chosen.
LIKELY_NATS = 4.0
# Probability that a person stands on both feet if contact is unknown. Chosen.
RESTING_SHARE = 0.3

# --- Modes

# Reduction of the energy by a step below which a minimisation stops, nats. Chosen.
MINIMUM_TOLERANCE = 0.02
# Largest standard deviation of a variable of a mode, without evidence, and that of a variable on
# its limit (3 degrees), rad or m. Chosen.
MAX_SIGMA, LIMIT_SIGMA = 2.0, 0.05
# Number of fits of the shape to the first image, and number of the heaviest modes that the shape is
# estimated from. Chosen.
FIRST_SHAPE_FITS, SHAPE_MODES = 3, 4
# Largest distance of a person from the prediction, m, and its growth with time, m/s: keypoints
# further away belong to another person. No clip reaches it.
BODY_REACH, BODY_SPEED = 0.1, 4.0
# Newton steps from the reversal of a mode to its optimum, before candidates are compared. Chosen.
REVERSAL_ITERATIONS = 8
# Number of bits of an identity below those for the posture of unseen limbs.
POSTURE_BITS = 20
