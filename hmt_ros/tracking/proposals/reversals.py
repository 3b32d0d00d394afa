"""Reversals: the whole pose the other way round in depth, left taken for right.

    x' = reversal of x (`body.mirror`),    log p(jump) = log epsilon

A silhouette hardly tells a pose from its reversal, so a turn can be taken the wrong way round, and
no jump of a limb leads back. The reversal of the best mode is proposed in every image; a person
does not turn about at once, but the track may have been wrong about the way the person faces.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hmt_ros.body.mirror import left_directions, reverse_depth
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.posterior import Posterior

# Newton steps from the reversal of a mode to its optimum, before candidates are compared.
ITERATIONS = 8
TURN = 9.0


@dataclass(frozen=True, eq=False)
class Reversals:
    """Proposes the reversals of the best modes.

    Attributes:
        posterior: of the body before the camera.
        probability: epsilon, prior probability that the track was wrong.
        count: number of modes that are reversed.
    """

    posterior: Posterior
    probability: float
    count: int = 1
    iterated: ClassVar[bool] = False

    def propose(
        self,
        base: Minimum,
        sources: Hypotheses,
        _covariances: Array,
        observation: Observation,
        _rng: np.random.Generator,
    ) -> Hypotheses:
        """See `Proposal`."""
        beta = self.posterior.trust.inverse_temperature
        best = np.argsort(beta * base.value - sources.log_weights, kind='stable')[: self.count]
        poses, rows = base.x[best], sources.texture_rows[best]
        nothing = np.full(len(best), -1)
        reversed_poses = reverse_depth(self.posterior.body, poses)
        moved = self.posterior.minimise(
            self.posterior.of_image(observation), reversed_poses, ITERATIONS
        ).x
        # The other side of the body was not seen in the last image: no texture can be compared.
        # That must not be an advantage.
        compared = self.posterior.values(poses, observation, sources.textures, rows)
        bare = self.posterior.values(poses, observation, sources.textures, nothing)
        body = self.posterior.body
        cosine = (left_directions(body, moved) * left_directions(body, poses)).sum(1)
        turn = TURN * 0.5 * (1.0 - cosine)
        return Hypotheses(
            moved,
            sources.log_weights[best] + np.log(self.probability) - turn - beta * (compared - bare),
            sources.ancestors[best],
            moved,
            np.ones(poses.shape, dtype=np.bool_),
            sources.textures,
            nothing,
        )
