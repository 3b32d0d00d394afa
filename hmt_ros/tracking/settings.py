"""Settings of a tracker, and constants of its model.

Users choose the settings. Each constant has its unit and its source: `Physical` constants are
properties of people or sensors, `Chosen` constants were tuned by hand on tracked clips. Lower
layers define their own constants: `body` for the person, `image` for silhouettes, colours and
keypoints, and `inference.error_model` for errors of cues.
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

# Number of evaluations per image above which accuracy hardly improves. Chosen on tracked clips.
ACCURATE_BUDGET = 400
# Ratio of actual to expected squared motion of the heaviest mode above which an image is
# surprising; below 1, because the motion prior is wider than most motions. Chosen.
SURPRISING_RATIO = 0.3
# Factor on the budget of a surprising image. Chosen.
SURPRISING_FACTOR = 4
# Distances of joints below which two trunks, and two configurations of a limb, are the same, m.
# Chosen.
SAME_TRUNK_DISTANCE, SAME_LIMB_DISTANCE = 0.06, 0.08
# Degrees of freedom of the Student prior around the prediction of a limb. Chosen.
LIMB_TAILS = 4.0
# Factor on the standard deviations of the body's prior for drawing limb configurations. Chosen.
PRIOR_STRETCH = 1.3
# Maximum distance of a joint in the selection of hypotheses, m. Chosen.
MAX_JOINT_DISTANCE = 0.3

# --- Weights and modes

# Mean squared distance of joints from their prediction, m^2/s, and degrees of freedom of its
# Student density: modes jitter, and limbs are found in unexpected places. Chosen.
TRANSITION_SPREAD, TRANSITION_TAILS = 0.01, 2.0
# Constant c, nats: a mode ends if all its continuations are less likely than exp(-c). Chosen.
END_NATS = 5.0
# Largest shift from a posterior mode to the likelihood's mode, in standard deviations of the
# posterior, because a likelihood may be flat. Chosen.
MAX_MODE_SHIFT = 5.0
# Standard deviations above which a measurement is unexplained or a value implausible. Chosen.
GATE_SIGMAS = 4.0

# --- Start of a track

# Standard deviation of a length measured with a tape, m. Physical.
MEASURED_SIGMA = 0.01
# Standard deviation of the position of a person in a box, as a fraction of the distance. Chosen.
BOX_SIGMA = 0.15
# Number of headings from which a pose is fitted. Chosen.
HEADING_COUNT = 8
# Maximum number of poses at the start of a track. Chosen.
MAX_STARTS = 96
# Distance in some joint above which two starts are distinct, m. Chosen.
START_DISTANCE = 0.03
# Time in which a person hardly moves, s. Chosen.
SAME_MOMENT_TIME = 0.2

# --- Shape of the person

# Largest change of the shape in one image, and in total, in standard deviations over people.
# Chosen.
MAX_SHAPE_STEP, MAX_SHAPE_CHANGE = 0.5, 3.0
# Change of the shape estimate above which the body and its dependents are rebuilt, in standard
# deviations over people (2 mm for a length). Chosen.
REBUILDING_CHANGE = 0.1
# Largest change of an angle due to a change of the shape, rad. Chosen.
MAX_ANGLE_SHIFT = 0.2

# --- Gravity and floor

# Default standard deviation of a given direction of gravity, rad, due to the camera mount.
# Physical.
GIVEN_UP_SIGMA = np.radians(2.0)
# Standard deviation of the angle between gravity and the image's y axis for handheld cameras, rad.
# Chosen.
UP_SIGMA = np.radians(15.0)
# Standard deviation of the angle between the axis of a standing body and the vertical, rad, twice
# as large along the line of sight; also a lower bound on the error of the estimated vertical.
# Chosen.
AXIS_SIGMA = np.radians(4.0)
# Correlation time of errors of the vertical from the body's axis or from lines, s. Chosen.
VERTICAL_TIME = 1.0
# Drift of the vertical, rad/sqrt(s). Chosen.
UP_DRIFT = np.radians(1.0)
# Time window for the level of the lowest sole, s, and quantile of these levels at the floor.
# Chosen.
LEVEL_TIME, LEVEL_QUANTILE = 2.0, 0.75
# Standard deviation of the floor's height from the quantile of levels, m; larger with few images.
# Chosen.
LEVEL_SIGMA = 0.04
# Change of the given direction of gravity that indicates a turning camera, rad; above sensor noise.
# Physical.
TURN_NOISE = 0.003
# Number of images with a person head down after which a given vertical that points up in the image
# is reversed: handstands are shorter. Each image is weighted by the cosine of the angle between
# trunk and vertical. Chosen.
HEAD_DOWN_IMAGES = 30.0
# Prior log odds for the given vertical of a nearly upright camera, nats, and bound on the evidence
# against it from a person's axis, because some people do lie down. Chosen.
RIGHT_VERTICAL_NATS = 3.5
# Largest log odds from one evaluation of the lines of the scene, nats. Chosen.
LOOK_NATS = 2.0
# Concentration of the body axis about the vertical, for people who are not lying down. Chosen.
UPRIGHT_CONCENTRATION = 8.0

# --- Camera and appearance

# Maximum time for which the last known motion of the camera is extrapolated, s. Chosen.
MAX_EXTRAPOLATION_TIME = 0.5
# Minimum fraction that is regarded as most of an image or of a person.
MAJORITY_FRACTION = 0.5
# Fraction of the usual value at which a silhouette is no evidence; 0 is full evidence of absence,
# and twice this fraction is full evidence of presence. Chosen.
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
    """Allocation of evaluations in an image; limits are counts, not times, for repeatable results.

        budget B    predictions descend    limbs and trunks are rated    candidates descend
        share       about B / 8            at most 2 B / 3                about B / 5

    If limbs are searched too, at most 2 B / 5 poses are rated. The rest of the budget is for
    covariances and shape of the modes, and for the likelihood. Settings bound each part; a smaller
    budget reduces all parts.

    Attributes:
        hypotheses: maximum number of modes that are kept, K.
        candidates: maximum number of hypotheses that are fully optimised.
        iterations: maximum number of Newton steps, for predictions and for candidates.
        groups: maximum number of searched groups; the modes of a group have a common trunk.
        rated: maximum number of rated poses in all groups, if limbs are searched.
        rated_alone: maximum number of rated poses in all groups, if no limb is searched.
        alternatives: maximum number of configurations per limb.
        combinations: maximum number of combinations of limb configurations on each trunk.
        searched_chains: maximum number of limbs searched in each group.
        samples, refined: number of samples per limb, and number of best samples to refine.
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
        evaluation_budget: Approximate number of pose evaluations per image; 400 is accurate, 300
            nearly so, and with fewer accuracy falls gradually.
        max_hypotheses: Maximum number K of modes that are kept.
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
        lifter: Experts that estimate the depth of joints from the keypoints of the last images:
            'keypoints' (shipped) or a file written by 'learn lifter'; if empty, keypoints are used
            without lifting.
        threads: Number of threads that share the poses of an image; 0 selects one per core, at most
            8, and leaves one core free. Results do not depend on it.
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
            # Below a quarter of the accurate budget, limb searches are skipped.
            searched_chains=min(self.searched_chains, searched)
            if SURPRISING_FACTOR * budget >= ACCURATE_BUDGET
            else 0,
            samples=min(self.search.samples, eighth),
            refined=min(self.search.refined, max(limbs // 2, 1)),
            surprising=False,
        )


# --- Beliefs of a track

# Transition rates into and out of the second state of two-state chains, 1/s.
RATES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        # A person enters an empty view, and leaves it. Chosen.
        'existence': (0.1, 0.2),
        # Another person replaces the unseen person once in an hour. Chosen.
        'same person': (0.0, 1.0 / 3600.0),
        # A track or a cue recovers from a failure, and fails. Chosen.
        'track and cues': (1.0, 0.05),
        # A detector returns to the person, and switches to another person. Chosen.
        'detector': (1.0, 0.02),
    }
)
# Largest log likelihood ratio of a person against nobody in view from an image, nats, and
# correlation time of its errors, s. A clear image is wrong in 1 of 3,000 cases, from a persistent
# cause outside the model. A detector misses a badly visible person in about 1 of 100 images, and
# for a longer time. Chosen.
EXISTENCE_CUES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {'clear': (8.0, 0.2), 'doubtful': (5.0, 0.25)}
)
# Probabilities of existence above which a person is present and a new track may start, and below
# which nobody is present, if the image supports it. Chosen.
PRESENT_PROBABILITY, ABSENT_PROBABILITY = 0.85, 0.03
# Weight of a silhouette that the image border may cut, and of keypoints of a part of a person.
# Chosen.
PART_FRACTION = 0.6
# Difference in evidence between a fully explained and a fully unexplained cue, nats, and number of
# measurements for full evidence: neighbours have common errors. Chosen.
VALIDITY_NATS, VALIDITY_COUNT = 16.0, 4
# Correlation time of misfits of the modes to a cue, s. Chosen.
MISFIT_TIME = 0.1
# Maximum evidence from one image about a cue, nats, because of unmodelled errors. Chosen.
MAX_CUE_NATS = 3.5
# Probability that a mode places a body part correctly: limbs lag behind, and are hard to see in
# front of the trunk. Chosen.
PLACED_PROBABILITY = 0.8
# Probability that the evidence of an image for a facing direction is about the person. Chosen.
FACING_VALIDITY = 0.9
# Largest log odds of a facing direction, nats, also for a start in which all poses face one way.
# Chosen.
MAX_FACING_NATS = 10.0
# Minimum probability that a detector exchanges sides. Chosen.
MIN_EXCHANGE_PROBABILITY = 1e-6
# Largest difference in log weight between the heaviest mode and a likely mode, nats. Chosen.
LIKELY_NATS = 4.0
# Probability that a person stands on both feet if contact is unknown. Chosen.
RESTING_SHARE = 0.3

# --- Modes

# Decrease of the energy per step below which a minimisation stops, nats. Chosen.
MINIMUM_TOLERANCE = 0.02
# Standard deviations of a variable of a mode, rad or m: maximum, without evidence, and on a limit
# (3 degrees). Chosen.
MAX_SIGMA, LIMIT_SIGMA = 2.0, 0.05
# Number of shape fits to the first image, and number of heaviest modes used in a fit. Chosen.
FIRST_SHAPE_FITS, MAX_SHAPE_MODES = 3, 4
# Largest distance of a person from the prediction, m, and its growth with time, m/s; keypoints
# further away belong to another person. No clip reaches it.
BODY_REACH, BODY_SPEED = 0.1, 4.0
# Number of Newton steps for a reversed mode before it is compared with candidates. Chosen.
REVERSAL_ITERATIONS = 8
# Number of low bits of an identity, below the bits for the posture of unseen limbs.
POSTURE_BITS = 20
