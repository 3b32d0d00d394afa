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
        max_hypotheses: modes that are kept, K.
        hypothesis_merge_distance: mean distance of the joints below which two modes are one, m.
        proposals: 'kjs' (covariance-scaled samples and kinematic jumps), 'css' or 'ss' (samples
            alone).
        candidates: hypotheses that are optimised fully an image.
        combinations: combinations of chain alternatives that are rated an image.
        alternatives: configurations of a chain that are rated.
        samples: samples an image of 'css' and 'ss'.
        sample_scale: their stretch; 0: Cauchy tails.
        reweighting: what the images before say of a new mode: 'ancestry', the weight of the mode it
            comes from and of its jumps, or 'bhattacharyya', the weight of the nearest mode before
            (KJS 5.1).
        exploration: power of the weights when candidates are chosen; below 1 favours unlikely ones.
        vote: how chains are chosen for search: 'trace', 'uniform' or 'minima'.
        searched_chains: chains searched in an image.
        edge_jumps: other image edges that are looked for in an image that is searched again, for a
            limb whose contour costs more than usual; 0: none.
        voted_swaps: whether arms, and legs, are only exchanged where they lie over each other or
            cost more than usual, and otherwise with jump_probability; else in every image.
        surprise: an image whose least energy exceeds the usual one by this is searched again.
        rounds: of search in such an image at most.
        jump_probability: of a flip of one chain from one image to the next.
        edge_probability: of a limb on another image edge than in the image before.
        prediction_probability: of a pose that a regression predicts from the image, and not the
            images before.
        facing_trial: seconds that both ways to face are followed at most, where a track starts from
            silhouettes or predictions alone; 0: the better one at once. It costs twice the time.
        base_iterations, iterations: Newton steps on the predictions and on the candidates.
        temperature: factor on the image's energy in a mode's weight; below 1 because neighbouring
            measurements err together.
        image_trust: factor on the curvature of the image's energy, keypoints apart, in a mode's
            covariance; below 1 because shapes, shadows and clothes are not the model's.
        tails: degrees of freedom of the Student distribution around a prediction.
        least_log_weight: no kept mode's weight falls below this.
        flesh_images: images from which the widths of the flesh are estimated; 0: the model's.
        lost_misfit: share of the outline, or of the keypoints, that no mode explains, above which
            an image counts as lost.
        lost_images: so many in a row start the track anew.
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
