"""Poses that keypoints alone would have: a silhouette of something else draws modes away from them.

    x' = argmin sum_p d_p(x)^2 / 2 + E_prior(x) + (x - f)' P (x - f) / 2

d_p is the distance to keypoint p in deviations, f where the heaviest mode is predicted, and P the
precision of that prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.energy import Quadratic, Sum
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.optimisation import Search


def pose_by_keypoints(search: Search, before: Array | None = None) -> Array:
    """A pose moved to the keypoints of an image, whatever its silhouette, (1, d).

    Args:
        search: of the image.
        before: (1, d) by the keypoints of the image before; None: the heaviest mode.

    Raises:
        ValueError: there are no keypoints.
    """
    posterior = search.posterior
    first = search.continuity.predicted[:1] if before is None else before
    placing = posterior.placing(search.observation)
    if placing is None:
        raise ValueError('there are no keypoints to move a pose to')
    term = Sum((placing, Quadratic(first, search.precisions[:1])))
    return posterior.minimise(term, first, posterior.settings.iterations).x


@dataclass(frozen=True)
class KeypointPoses:
    """Proposes the heaviest mode as keypoints alone would have it."""

    def propose(
        self, search: Search, _base: Minimum, sources: Hypotheses, _rng: np.random.Generator
    ) -> Hypotheses:
        """See `Proposal`."""
        pose = pose_by_keypoints(search)
        return Hypotheses(
            pose, sources.log_weights[:1], sources.ancestors[:1], pose,
            np.zeros(pose.shape, dtype=np.bool_),
        )  # fmt: skip
