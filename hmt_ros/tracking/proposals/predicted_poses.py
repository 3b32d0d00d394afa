"""Pose hypotheses from an external single-image predictor, such as a mixture of experts.

They are proposals, no evidence, which would count the image twice.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.posterior import Posterior


@dataclass(frozen=True, eq=False)
class PredictedPoses:
    """Proposes the means of a prediction, if there is one, each as a jump from the nearest mode.

    Attributes:
        posterior: of the body before the camera.
    """

    posterior: Posterior

    def propose(
        self, search: Search, _base: Minimum, sources: Hypotheses, _rng: np.random.Generator
    ) -> Hypotheses:
        """See `Proposal`."""
        if search.prediction is None:
            return sources[:0]
        poses = search.prediction.seen_as(self.posterior.person).means
        nearest = search.continuity.log_transitions(poses).argmax(0)
        return sources.proposed(nearest, poses, np.ones(poses.shape, dtype=np.bool_))
