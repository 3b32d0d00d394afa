"""Propose: where hypotheses come from (KJS 3 and 5). Each proposal is an object of its own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.proposals.keypoint_poses import KeypointPoses
from hmt_ros.tracking.proposals.kinematic_jumps import KinematicJumps
from hmt_ros.tracking.proposals.predicted_poses import PredictedPoses
from hmt_ros.tracking.proposals.reversals import Reversals
from hmt_ros.tracking.proposals.sampling import CovarianceScaledSamples, SphericalSamples


class Proposal(Protocol):
    """Something that proposes hypotheses for an image."""

    def propose(
        self, search: Search, base: Minimum, sources: Hypotheses, rng: np.random.Generator
    ) -> Hypotheses:
        """Hypotheses that are to be optimised, if any; a proposal does not set their weights.

        Args:
            search: of the image.
            base: optima of the image, one for each of
            sources: the hypotheses that they were optimised from.
            rng: source of randomness.
        """
        ...


# Of every tracker, before the one that the setting `proposals` selects. Each decides by itself
# whether it applies to an image. A new proposal is a file beside this one and a name here.
USUAL: tuple[Callable[[Posterior], Proposal], ...] = (PredictedPoses, KeypointPoses, Reversals)
SELECTED: dict[str, Callable[[Posterior], Proposal]] = {
    'kjs': KinematicJumps,
    'css': CovarianceScaledSamples,
    'ss': SphericalSamples,
}


def proposals_of(posterior: Posterior) -> list[Proposal]:
    """The proposals of a tracker, by its settings."""
    return [make(posterior) for make in (*USUAL, SELECTED[posterior.settings.proposals])]
