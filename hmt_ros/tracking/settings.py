"""How poses are tracked: all settings of a tracker."""

from __future__ import annotations

from dataclasses import dataclass, field

from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.tracking.ground import GroundSettings
from hmt_ros.tracking.proposals import PROPOSALS
from hmt_ros.tracking.proposals.chain_votes import VOTES
from hmt_ros.tracking.weighting import REWEIGHTINGS

MOTIONS = ('learned', 'random_walk')


@dataclass(frozen=True)
class LimbSearchSettings:
    """How limbs are searched.

    Attributes:
        samples: Number of samples that a limb draws; a third from the mode, a third from it
            stretched, a third from the body's prior.
        stretch: Factor on the deviations of the second third.
        refined: Number of best samples that are refined.
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
        max_hypotheses: Maximum number of modes that are kept, K.
        hypothesis_merge_distance: Mean distance of the joints below which two modes are merged, m.
        proposals: Proposal distribution: 'kjs' (kinematic jumps and covariance-scaled samples),
            'css' (covariance-scaled samples alone) or 'ss' (spherical samples alone).
        candidates: Maximum number of hypotheses that are fully optimised in an image.
        combinations: Number of combinations of limb configurations that are rated for each trunk.
        alternatives: Maximum number of configurations of a limb that are rated.
        samples: Number of samples drawn in an image by the proposals 'css' and 'ss'.
        sample_scale: Scale of the proposal covariance; 0 selects Cauchy tails.
        reweighting: Prior weight of a new mode: 'ancestry', that of the mode it comes from and of
            its jumps, or 'bhattacharyya', that of the nearest predicted mode (KJS figure 4, step
            5).
        exploration: Exponent of the weights when candidates are chosen; below 1 it favours unlikely
            ones.
        vote: Rule that chooses limbs for search: 'trace', 'minima' or 'uniform'.
        searched_chains: Number of chains searched in an image.
        energy_rise: Rise of the least energy over the usual one, nats, above which an image is
            searched again.
        rounds: Maximum number of search rounds in an image.
        jump_probability: Prior probability that a limb flips between two images.
        prediction_probability: Prior probability that a pose comes from a single-image prediction
            and not from the image before.
        reversal_probability: Prior probability that the track has taken the pose for its reversal
            in depth, for a reversal that turns the person by little; 0 proposes none.
        reach: Log weight below the heaviest mode, nats, to which the best mode of another heading,
            lean or order of the legs is kept.
        facing_gain: Share of the trust with which a difference of energies between the two ways to
            face is counted in every image.
        facing_trial: Maximum time for which both facing directions are followed after a start from
            silhouettes or predictions alone, s; 0 keeps the better one at once. The trial doubles
            the cost of an image.
        base_iterations: Number of Newton steps on the predictions.
        iterations: Number of Newton steps on the candidates.
        trust: Largest share of the energy of an image that is believed when hypotheses are weighed;
            values below 1 allow for correlated errors of neighbouring measurements.
        error_correlation: Correlation of the errors of an image, such as a shape that the model
            lacks, with those of the image before.
        motion: Motion prior: 'learned', where the body ships with one, or 'random_walk' at the
            rates of the body.
        tails: Degrees of freedom of the Student motion prior; small numbers give heavy tails.
        least_log_weight: Smallest log weight of a mode that is kept, nats.
        shape_images: Number of images at the start of a track that are all used to estimate the
            lengths and the flesh of the person; 0 keeps those that the track started with.
        shape_interval: After these, one image of so many is used to estimate them; 0 uses none.
        lost_misfit: Fraction of the outline, or of the keypoints, left unexplained by every mode
            above which an image counts as lost.
        lost_images: Number of consecutive lost images after which the track restarts.
        likelihood: settings of the likelihood.
        search: settings of the search of limbs.
        ground: settings of what is known of gravity and floor.
    """

    max_hypotheses: int = 8
    hypothesis_merge_distance: float = 0.02
    proposals: str = 'kjs'
    candidates: int = 16
    combinations: int = 96
    alternatives: int = 10
    samples: int = 256
    sample_scale: float = 2.0
    reweighting: str = 'ancestry'
    exploration: float = 0.5
    vote: str = 'trace'
    searched_chains: int = 4
    energy_rise: float = 6.0
    rounds: int = 3
    jump_probability: float = 0.1
    prediction_probability: float = 0.01
    reversal_probability: float = 0.05
    reach: float = 20.0
    facing_gain: float = 0.4
    facing_trial: float = 2.0
    base_iterations: int = 6
    iterations: int = 6
    trust: float = 0.35
    error_correlation: float = 0.8
    motion: str = 'learned'
    tails: float = 10.0
    least_log_weight: float = -14.0
    shape_images: int = 15
    shape_interval: int = 3
    lost_misfit: float = 0.35
    lost_images: int = 5
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    search: LimbSearchSettings = field(default_factory=LimbSearchSettings)
    ground: GroundSettings = field(default_factory=GroundSettings)

    def __post_init__(self) -> None:
        if self.proposals not in PROPOSALS:
            raise ValueError(f'proposals must be one of {tuple(PROPOSALS)}, saw {self.proposals!r}')
        if self.reweighting not in REWEIGHTINGS:
            raise ValueError(f'reweighting must be one of {REWEIGHTINGS}, saw {self.reweighting!r}')
        if self.motion not in MOTIONS:
            raise ValueError(f'motion must be one of {MOTIONS}, saw {self.motion!r}')
        if self.vote not in VOTES:
            raise ValueError(f'vote must be one of {VOTES}, saw {self.vote!r}')
        if self.max_hypotheses < 1 or self.candidates < self.max_hypotheses:
            raise ValueError(
                f'wanted 1 <= max_hypotheses <= candidates, saw {self.max_hypotheses} and '
                f'{self.candidates}'
            )
        least = {'samples': 1, 'rounds': 1, 'iterations': 1, 'base_iterations': 1, 'lost_images': 1}
        least |= {'combinations': 1, 'alternatives': 1, 'trust': 0, 'exploration': 0}
        least |= {'facing_trial': 0}
        for name, bound in least.items():
            if not getattr(self, name) >= bound:
                raise ValueError(f'{name} must be at least {bound}, saw {getattr(self, name)}')
        if not self.tails > 0:
            raise ValueError(f'tails must be positive, saw {self.tails}')
        for name in ('jump_probability', 'prediction_probability'):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f'{name} must lie in (0, 1), saw {getattr(self, name)}')
