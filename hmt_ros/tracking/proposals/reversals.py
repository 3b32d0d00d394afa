"""Reversals: the whole pose the other way round in depth, left taken for right.

    x' = reversal of x (`body.mirror`)

A silhouette hardly tells a pose from its reversal, so a turn can be taken the wrong way round, and
no jump of a limb leads back. Where no mode of comparable weight faces one of the two ways, the best
mode is reversed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.body.mirror import reverse_depth
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.classes import lost_a_facing
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.settings import REVERSAL_ITERATIONS


@dataclass(frozen=True, eq=False)
class Reversals:
    """Proposes the reversal of the best mode where a way to face is lost.

    Attributes:
        posterior: of the body before the camera.
    """

    posterior: Posterior

    def propose(
        self, search: Search, base: Minimum, sources: Hypotheses, _rng: np.random.Generator
    ) -> Hypotheses:
        """See `Proposal`."""
        log_weights = search.rated(base.x, base.value)
        if not lost_a_facing(search.modes.back, log_weights):
            return sources[:0]
        best = np.argsort(-log_weights, kind='stable')[:1]
        turned = reverse_depth(self.posterior.body, base.x[best])
        term = self.posterior.of_image(search.observation)
        moved = self.posterior.minimise(term, turned, REVERSAL_ITERATIONS).x
        return sources.proposed(best, moved, np.ones(moved.shape, dtype=np.bool_))
