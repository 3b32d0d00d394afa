"""How poses are tracked: all settings of a tracker."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType

from hmt_ros.body.ground_terms import GroundSettings
from hmt_ros.experts.lifter import SHIPPED
from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.tracking.evaluation_plan import ACCURATE, EvaluationPlan, plan_of

MOTIONS = ('learned', 'random_walk')
# Names of the proposals, whose classes are in `tracking.proposals`.
PROPOSALS = ('kjs', 'css', 'ss')


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
class TrackerSettings:
    """How poses are tracked.

    Attributes:
        evaluation_budget: Number of evaluations of poses that an image may take, about: 400 is
            accurate, 300 is nearly so, and with fewer quality falls step by step.
        max_hypotheses: Maximum number of modes that are kept, K.
        hypothesis_merge_distance: Mean distance of the joints below which two modes are merged, m.
        proposals: Proposal distribution: 'kjs' (kinematic jumps and covariance-scaled samples),
            'css' (covariance-scaled samples alone) or 'ss' (spherical samples alone).
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
            'keypoints', which ships, or a file that learn-lifter wrote; if empty, keypoints count
            by themselves.
        threads: Number of threads that share the poses of an image; 0 takes one a core, 8 at most,
            and leaves one core to others.
            Results do not depend on it.
        likelihood: settings of the likelihood.
        search: settings of the search of limbs.
        ground: settings of what is known of gravity and floor.
    """

    evaluation_budget: int = ACCURATE
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
    lifter: str = SHIPPED
    threads: int = 0
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    search: LimbSearchSettings = field(default_factory=LimbSearchSettings)
    ground: GroundSettings = field(default_factory=GroundSettings)

    def __post_init__(self) -> None:
        if self.proposals not in PROPOSALS:
            raise ValueError(f'proposals must be one of {tuple(PROPOSALS)}, saw {self.proposals!r}')
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
        return plan_of(self)

    @cached_property
    def thorough_plan(self) -> EvaluationPlan:
        """The same for a surprising image; as many modes are kept."""
        return replace(plan_of(self, surprising=True), hypotheses=self.plan.hypotheses)


# --- Beliefs of a track

# Rates at which chains of two states begin and end, 1/s.
RATES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {
        # Somebody comes into an empty view, and leaves it. Chosen.
        'existence': (0.1, 0.2),
        # Another takes the place of who was seen last, unseen, once in an hour. Chosen.
        'same person': (0.0, 1.0 / 3600.0),
        # A track follows again, and fails; a cue shows the person again, or something else.
        # Chosen.
        'track and cues': (1.0, 0.05),
        # A detector as a whole shows the person again, and somebody else. Chosen.
        'detector': (1.0, 0.02),
    }
)
# Largest log likelihood ratio of somebody against nobody in an image, nats, and how long its errors
# last, s. A clear image is wrong in 1 of 3,000 cases, by some lasting cause that is not modelled. A
# detector misses a badly visible person in about 1 of 100 images, for longer. Chosen.
EXISTENCE_CUES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {'clear': (8.0, 0.2), 'doubtful': (5.0, 0.25)}
)
# Probability of existence above which somebody is there, and a new track may start, and below which
# nobody is, if the image says so. Between them it is undecided. Chosen.
PRESENT_PROBABILITY, ABSENT_PROBABILITY = 0.85, 0.03
# Fraction of a cue that is left to a silhouette which a side of the image may cut, and to keypoints
# of a part of a person. Chosen.
PART_FRACTION = 0.6
# Evidence of a cue that is wholly explained against one that is not at all, nats, and the number of
# its measurements that give it: neighbours err together. Chosen.
VALIDITY_NATS, VALIDITY_COUNT = 16.0, 4
# How long misfits of the modes to a cue last, s. Chosen.
MISFIT_TIME = 0.1
# Maximum evidence of one image about a cue, nats: it may be wrong in unforeseen ways. Chosen.
MAX_CUE_NATS = 3.5
# Probability that a mode has a part of the body where it is: limbs lag behind, and hide before the
# trunk. Chosen.
PLACED_PROBABILITY = 0.8
# Probability that the evidence of an image for a facing direction is about the person. Chosen.
FACING_VALID = 0.9
# Largest log odds of a facing direction, nats: those against a way that a start lacks. Chosen.
MAX_FACING_NATS = 10.0
# Least probability of an exchange of sides by a detector. Chosen.
LEAST_EXCHANGE = 1e-6
# Log weight below that of the heaviest mode up to which modes show where the person may be, nats.
# Chosen.
LIKELY_NATS = 4.0
# Share of the time for which somebody stands on both feet, where contact is unknown. Chosen.
RESTING_SHARE = 0.3

# --- Modes

# Gain by a step below which a minimum is found, nats. Chosen.
MINIMUM_TOLERANCE = 0.02
# Largest standard deviation of a variable of a mode, where an image shows nothing, and that of one
# which rests on its limit (3 degrees), rad or m. Chosen.
MAX_SIGMA, LIMIT_SIGMA = 2.0, 0.05
# How often the shape is fitted to the first image, and the number of the heaviest modes that it is
# estimated from. Chosen.
FIRST_SHAPE_FITS, SHAPE_MODES = 3, 4
# Newton steps from the reversal of a mode to its optimum, before candidates are compared. Chosen.
REVERSAL_ITERATIONS = 8
# Bits of an identity below the number of the posture of unseen limbs.
POSTURE_BITS = 20
