"""How poses are tracked: all settings of a tracker."""

from __future__ import annotations

from dataclasses import dataclass, field

from hmt_ros.image.likelihood import LikelihoodSettings
from hmt_ros.image.observation import ObservationSettings
from hmt_ros.tracking.chain_search import ChainSearchSettings
from hmt_ros.tracking.chain_votes import VOTES
from hmt_ros.tracking.dynamics import DynamicsSettings
from hmt_ros.tracking.proposals import PROPOSALS

REWEIGHTINGS = ('ancestry', 'bhattacharyya')


@dataclass(frozen=True)
class TrackerSettings:
    """How poses are tracked.

    Attributes:
        max_hypotheses: Maximum number of modes that are kept, K.
        hypothesis_merge_distance: Mean distance of the joints below which two modes are merged, m.
        proposals: Proposal distribution: 'kjs' (kinematic jumps and covariance-scaled samples),
            'css' (covariance-scaled samples alone) or 'ss' (spherical samples alone).
        candidates: Maximum number of hypotheses that are fully optimised in an image.
        combinations: Maximum number of combinations of chain configurations rated in an image.
        alternatives: Maximum number of configurations of a chain that are rated.
        samples: Number of samples drawn in an image by the proposals 'css' and 'ss'.
        sample_scale: Scale of the proposal covariance; 0 selects Cauchy tails.
        reweighting: Prior weight of a mode: 'ancestry' takes it from the mode that it descends from
            and the jumps on the way, 'bhattacharyya' from the nearest mode of the image before
            (KJS, figure 4, step 5).
        exploration: Power of the weights in the choice of candidates; values below 1 favour
            unlikely ones.
        vote: Rule that chooses the chains to search: 'trace', 'eigenvalue', 'uniform', 'depth' or
            'minima'.
        searched_chains: Number of chains searched in an image.
        edge_jumps: Number of other image edges tried for a limb whose contour costs more than
            usual, in an image that is searched again; 0 switches the search off.
        voted_swaps: If true, arms, and legs, are only exchanged where they overlap or cost more
            than usual, and otherwise with jump_probability; if false, in every image.
        surprise: Excess of the least energy of an image over the usual one above which the image is
            searched again.
        rounds: Maximum number of search rounds in a surprising image.
        jump_probability: Prior probability that a limb flips between two images.
        edge_probability: Prior probability that a limb moves to another image edge between two
            images.
        prediction_probability: Prior probability that a pose comes from the single-image predictor
            and not from the images before.
        facing_trial: Maximum time for which both facing directions are followed after a start from
            silhouettes or predictions alone, s; 0 keeps the better one at once. The trial doubles
            the cost of an image.
        base_iterations: Number of Newton steps on the predicted modes.
        iterations: Number of Newton steps on the candidates.
        temperature: Factor on the image energy in the weight of a mode; values below 1 allow for
            correlated errors of neighbouring measurements.
        image_trust: Factor on the curvature of the image energy, without keypoints, in the
            covariance of a mode; values below 1 allow for shapes, shadows and clothes that the
            model lacks.
        tails: Degrees of freedom of the Student distribution around a prediction.
        least_log_weight: Lower bound of the log weight of a kept mode.
        flesh_images: Number of images from which the widths of the body parts are estimated; 0
            keeps those of the model.
        lost_misfit: Fraction of the outline, or of the keypoints, left unexplained by every mode
            above which an image counts as lost.
        lost_images: Number of consecutive lost images after which the track starts anew.
        dynamics, likelihood, observation, search: settings of the parts.
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
    edge_jumps: int = 0
    voted_swaps: bool = False
    surprise: float = 6.0
    rounds: int = 3
    jump_probability: float = 0.1
    edge_probability: float = 0.02
    prediction_probability: float = 0.01
    facing_trial: float = 2.0
    base_iterations: int = 6
    iterations: int = 6
    temperature: float = 0.3
    image_trust: float = 0.05
    tails: float = 8.0
    least_log_weight: float = -10.0
    flesh_images: int = 15
    lost_misfit: float = 0.35
    lost_images: int = 5
    dynamics: DynamicsSettings = field(default_factory=DynamicsSettings)
    likelihood: LikelihoodSettings = field(default_factory=LikelihoodSettings)
    observation: ObservationSettings = field(default_factory=ObservationSettings)
    search: ChainSearchSettings = field(default_factory=ChainSearchSettings)

    def __post_init__(self) -> None:
        if self.proposals not in PROPOSALS:
            raise ValueError(f'proposals must be one of {PROPOSALS}, saw {self.proposals!r}')
        if self.reweighting not in REWEIGHTINGS:
            raise ValueError(f'reweighting must be one of {REWEIGHTINGS}, saw {self.reweighting!r}')
        if self.vote not in VOTES:
            raise ValueError(f'vote must be one of {VOTES}, saw {self.vote!r}')
        if self.max_hypotheses < 1 or self.candidates < self.max_hypotheses:
            raise ValueError(
                f'wanted 1 <= max_hypotheses <= candidates, saw {self.max_hypotheses} and '
                f'{self.candidates}'
            )
        least = {'samples': 1, 'rounds': 1, 'iterations': 1, 'base_iterations': 1, 'lost_images': 1}
        least |= {'combinations': 1, 'alternatives': 1, 'temperature': 0, 'exploration': 0}
        least |= {'facing_trial': 0}
        for name, bound in least.items():
            if not getattr(self, name) >= bound:
                raise ValueError(f'{name} must be at least {bound}, saw {getattr(self, name)}')
        if not self.tails > 0:
            raise ValueError(f'tails must be positive, saw {self.tails}')
        for name in ('jump_probability', 'edge_probability', 'prediction_probability'):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f'{name} must lie in (0, 1), saw {getattr(self, name)}')
