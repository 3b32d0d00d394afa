"""Poses that an external single-image predictor expects, such as a mixture of experts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import relevelled, reverse_depth
from hmt_ros.inference.mixture import GaussianMixture


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """A mixture over the poses of a body.

    Attributes:
        mixture: over poses (d,), with some weight above 0.
        body: of the poses, at the lengths that were assumed.

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
        """The same for a person of other lengths or level, at a distance in proportion to the size.

        Raises:
            ValueError: a body with other degrees of freedom.
        """
        if body.dof_names != self.body.dof_names:
            raise ValueError(
                f'a prediction for {self.body.name}, of {self.body.dimension} dimensions, saw the '
                f'body {body.name}, of {body.dimension}'
            )
        kept = relevelled(self.body, self.mixture[self.mixture.weights > 0].normalised(), body)
        means = np.array(kept.means)
        means[:, :3] *= body.scale / self.body.scale
        return GaussianMixture(
            kept.weights, np.clip(means, body.lower, body.upper), kept.covariances
        )

    def both_ways(self, body: Body) -> GaussianMixture:
        """As `seen_as`, with the reversals in depth, which have nearly the same silhouettes."""
        seen = self.seen_as(body)
        return GaussianMixture(
            np.tile(0.5 * seen.weights, 2),
            np.concatenate([seen.means, reverse_depth(body, seen.means)]),
            np.tile(seen.covariances, (2, 1, 1)),
        )
