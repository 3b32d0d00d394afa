"""Reversals: the whole pose the other way round in depth, left taken for right.

    x' = reversal of x (`body.mirror`)

A silhouette hardly tells a pose from its reversal, so a turn can be taken the wrong way round, and
no jump of a limb leads back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.body.mirror import reverse_depth
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.optimisation import Search

# Newton steps from the reversal of a mode to its optimum, before candidates are compared.
ITERATIONS = 8


@dataclass(frozen=True)
class Reversals:
    """Proposes the reversals of the best modes.

    Attributes:
        count: number of modes that are reversed.
    """

    count: int = 1

    def propose(
        self, search: Search, base: Minimum, sources: Hypotheses, _rng: np.random.Generator
    ) -> Hypotheses:
        """See `Proposal`."""
        best = np.argsort(-search.rated(base.x, base.value), kind='stable')[: self.count]
        posterior = search.posterior
        reversed_poses = reverse_depth(posterior.body, base.x[best])
        moved = posterior.minimise(
            posterior.of_image(search.observation), reversed_poses, ITERATIONS
        ).x
        return Hypotheses(
            moved,
            sources.log_weights[best],
            sources.ancestors[best],
            moved,
            np.ones(moved.shape, dtype=np.bool_),
        )
