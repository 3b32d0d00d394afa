"""The modes of the mixture that is propagated from observation to observation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.texture import Textures

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Modes:
    """A mixture over poses and how they move: K modes, heaviest first.

    Attributes:
        poses, velocities: (K, d), velocities per second.
        covariances: (K, d, d) of the posterior.
        filtered: (K, d, d) covariances that are propagated, as if errors were independent from
            image to image.
        log_weights: (K,) normalised.
        log_likelihoods: (K,) of the image at the poses.
        textures: of the image at the poses, or None.
    """

    poses: Array
    velocities: Array
    covariances: Array
    filtered: Array
    log_weights: Array
    log_likelihoods: Array
    textures: Textures | None

    def joined(self, other: Modes, log_shares: Array, count: int) -> Modes:
        """The heaviest modes of both, for the log probabilities (2,) of the two."""
        log_weights = np.concatenate(
            [self.log_weights + log_shares[0], other.log_weights + log_shares[1]]
        )
        kept = np.argsort(-log_weights, kind='stable')[:count]
        parts = {
            name: np.concatenate([getattr(self, name), getattr(other, name)])[kept]
            for name in ('poses', 'velocities', 'covariances', 'filtered', 'log_likelihoods')
        }
        log_weights = log_weights[kept]
        return Modes(
            log_weights=log_weights - np.logaddexp.reduce(log_weights), textures=None, **parts
        )
