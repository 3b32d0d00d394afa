"""Pose hypotheses from an external single-image predictor, such as a mixture of experts.

    log p(jump) = log epsilon + log w_m        of component m of the prediction

They are proposals, no evidence, which would count the image twice.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import reverse_depth
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.mixture import GaussianMixture
from hmt_ros.tracking.hypotheses import Hypotheses, relative_joints


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """A mixture over poses, and whose they are.

    Attributes:
        mixture: over poses (d,), with some weight above 0.
        body: that the poses are of, at the lengths that were assumed.

    Raises:
        ValueError: a mixture that is not over poses of the body.
    """

    mixture: GaussianMixture
    body: Body

    def __post_init__(self) -> None:
        if self.mixture.dimension != self.body.dimension:
            raise ValueError(
                f'a prediction for {self.body.name} has {self.body.dimension} dimensions, saw '
                f'{self.mixture.dimension}'
            )
        if not self.mixture.weights.sum() > 0:
            raise ValueError('a prediction has no weight')

    def seen_as(self, body: Body) -> GaussianMixture:
        """The same for a person of other lengths: as much further away as the person is larger.

        Raises:
            ValueError: a body with other degrees of freedom.
        """
        if body.dof_names != self.body.dof_names:
            raise ValueError(
                f'a prediction for {self.body.name}, of {self.body.dimension} dimensions, saw the '
                f'body {body.name}, of {body.dimension}'
            )
        kept = self.mixture[self.mixture.weights > 0].normalised()
        means = np.array(kept.means)
        means[:, :3] *= body.scale / self.body.scale
        return GaussianMixture(
            kept.weights, np.clip(means, body.lower, body.upper), kept.covariances
        )

    def both_ways(self, body: Body) -> GaussianMixture:
        """As `seen_as`, with the reversal in depth, which a silhouette does not tell from it."""
        seen = self.seen_as(body)
        return GaussianMixture(
            np.tile(0.5 * seen.weights, 2),
            np.concatenate([seen.means, reverse_depth(body, seen.means)]),
            np.tile(seen.covariances, (2, 1, 1)),
        )


@dataclass(frozen=True, eq=False)
class PredictedPoses:
    """Proposes the means of a prediction, each as a jump from the nearest mode.

    Attributes:
        body: of the person.
        prediction: over poses of the body, weights that sum to 1.
        probability: epsilon, prior probability of a pose that comes from the image alone.
    """

    body: Body
    prediction: GaussianMixture
    probability: float
    iterated: ClassVar[bool] = False

    def propose(
        self,
        _base: Minimum,
        sources: Hypotheses,
        _covariances: Array,
        _observation: Observation,
        _rng: np.random.Generator,
    ) -> Hypotheses:
        """See `Proposal`."""
        poses = self.prediction.means
        joints = (relative_joints(self.body, x) for x in (poses, sources.expected))
        apart = next(joints)[:, None] - next(joints)[None]
        nearest = np.linalg.norm(apart, axis=3).mean(2).argmin(1)
        return Hypotheses(
            poses,
            sources.log_weights[nearest] + np.log(self.probability * self.prediction.weights),
            sources.ancestors[nearest],
            poses,
            np.ones(poses.shape, dtype=np.bool_),
            sources.textures,
            sources.texture_rows[nearest],
        )
