"""Other headings: the best pose and the mean pose, turned about the spine.

    log p(jump) = log epsilon

When every mode explains an image badly, the trunk may be wrong, and jumps of limbs do not mend it.
Then poses of all headings at the same place, or where the keypoints are, are optimised, and the
best are proposed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import root_angles, root_rotation_dofs, root_rotations
from hmt_ros.image.observation import Observation
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.posterior import Posterior

# Headings of each pose.
COUNT = 8
# Newton steps from each.
ITERATIONS = 12
# Newton steps to the keypoints before, if there are any.
PLACING_STEPS = 10
# Number of optima that are proposed.
KEPT = 4


@dataclass(frozen=True, eq=False)
class Headings:
    """Proposes poses of other headings.

    Attributes:
        posterior: of the body before the camera.
        probability: epsilon, prior probability that the track was wrong.
    """

    posterior: Posterior
    probability: float
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
        body = self.posterior.body
        best = int(np.argmin(base.value))
        pose = base.x[best]
        upright = body.prior_mean.copy()
        upright[:6] = pose[:6]
        starts = np.concatenate([turned(body, one, COUNT) for one in (pose, upright)])
        placing = self.posterior.placing(observation)
        if placing is not None:
            starts = self.posterior.minimise(placing, starts, PLACING_STEPS).x
        term = self.posterior.of_image(observation)
        solved = self.posterior.minimise(term, starts, ITERATIONS)
        order = np.argsort(solved.value, kind='stable')[:KEPT]
        poses = solved.x[order]
        n = len(poses)
        return Hypotheses(
            poses,
            np.full(n, sources.log_weights[best] + np.log(self.probability)),
            np.full(n, sources.ancestors[best]),
            poses,
            np.ones(poses.shape, dtype=np.bool_),
            sources.textures,
            np.full(n, -1),
        )


def turned(body: Body, pose: Array, count: int) -> Array:
    """A pose (d,) turned about the spine at the pelvis in equal steps, (count, d)."""
    joints = body.joint_positions(pose[None])[0]
    pelvis, neck = joints[body.skeleton.joint_index(['pelvis', 'neck'])]
    spine = (neck - pelvis) / max(float(np.linalg.norm(neck - pelvis)), 1e-9)
    poses = np.repeat(pose[None], count, axis=0)
    angles = 2.0 * np.pi * np.arange(count) / count
    cross = np.cross(np.eye(3), spine)  # rows e_i x spine: the transpose of [spine]_x
    turns = (
        np.eye(3)
        - np.sin(angles)[:, None, None] * cross
        + (1.0 - np.cos(angles))[:, None, None] * (cross @ cross)
    )
    rotations = turns @ root_rotations(body, pose[None])
    poses[:, root_rotation_dofs(body.skeleton)] = root_angles(body, rotations)
    result: Array = np.clip(poses, body.lower, body.upper)
    return result
