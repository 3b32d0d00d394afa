"""Propose: where hypotheses come from (KJS 3 and 5). Each proposal is an object of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.proposals.kinematic_jumps import KinematicJumps
from hmt_ros.tracking.proposals.predicted_poses import PosePrediction, PredictedPoses
from hmt_ros.tracking.proposals.sampling import CovarianceScaledSamples, SphericalSamples

__all__ = [
    'PROPOSALS',
    'KinematicJumps',
    'PosePrediction',
    'PredictedPoses',
    'Proposal',
]


class Proposal(Protocol):
    """Something that proposes hypotheses for an image.

    Attributes:
        iterated: whether it proposes again, around the optima, when their energies are unusually
            high.
    """

    @property
    def iterated(self) -> bool:
        """See the class."""
        ...

    def propose(
        self,
        base: Minimum,
        sources: Hypotheses,
        covariances: Array,
        observation: Observation,
        rng: np.random.Generator,
    ) -> Hypotheses:
        """Hypotheses that are to be optimised.

        Args:
            base: optima of the image, one for each of
            sources: the hypotheses that they were optimised from.
            covariances: (K, d, d) of the predictions, which the ancestors of the sources index.
            observation: of the image.
            rng: source of randomness.
        """
        ...


# What the setting `proposals` selects. A new proposal is a file beside this one and a line here.
PROPOSALS: dict[str, Callable[[Posterior], Proposal]] = {
    'kjs': KinematicJumps,
    'css': CovarianceScaledSamples,
    'ss': SphericalSamples,
}
