"""How poses are tracked: all settings of a tracker."""

from __future__ import annotations

from dataclasses import dataclass, field

from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.tracking.ground import GroundSettings
from hmt_ros.tracking.proposals import PROPOSALS

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
        searched_chains: Number of limbs searched in an image, chosen at random.
        iterations: Number of Newton steps on the predictions, and on the candidates.
        motion: Motion prior: 'learned', where the body ships with one, or 'random_walk' at the
            rates of the body.
        flow_weight: Number of independent measurements that the optical flow counts for where it
            corrects predictions; 0 switches it off.
        least_log_weight: Smallest log weight of a mode that is kept, nats.
        estimate_shape: Whether lengths and flesh of the person are estimated while the track lasts.
        threads: Number of threads that share the poses of an image; 0 takes one a core, 8 at most.
            Results do not depend on it.
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
    searched_chains: int = 4
    iterations: int = 6
    motion: str = 'learned'
    flow_weight: float = 5.0
    least_log_weight: float = -14.0
    estimate_shape: bool = True
    threads: int = 0
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    search: LimbSearchSettings = field(default_factory=LimbSearchSettings)
    ground: GroundSettings = field(default_factory=GroundSettings)

    def __post_init__(self) -> None:
        if self.proposals not in PROPOSALS:
            raise ValueError(f'proposals must be one of {tuple(PROPOSALS)}, saw {self.proposals!r}')
        if self.motion not in MOTIONS:
            raise ValueError(f'motion must be one of {MOTIONS}, saw {self.motion!r}')
        if self.max_hypotheses < 1 or self.candidates < self.max_hypotheses:
            raise ValueError(
                f'wanted 1 <= max_hypotheses <= candidates, saw {self.max_hypotheses} and '
                f'{self.candidates}'
            )
        least = {'samples': 1, 'iterations': 1}
        least |= {'combinations': 1, 'alternatives': 1}
        for name, bound in least.items():
            if not getattr(self, name) >= bound:
                raise ValueError(f'{name} must be at least {bound}, saw {getattr(self, name)}')
        if self.threads < 0:
            raise ValueError(f'threads must be at least 0, saw {self.threads}')
        if not self.flow_weight >= 0:
            raise ValueError(f'flow_weight must be at least 0, saw {self.flow_weight}')
