"""Whole poses to search from: predicted ones, by keypoints alone, and reversed ones.

Pose hypotheses from an external single-image predictor, such as a mixture of experts, are
proposals, no evidence, which would count the image twice.

Poses fitted to keypoints alone, from which a silhouette of something else draws modes away:

    x' = argmin sum_p d_p(x)^2 / 2 + E_prior(x) + (x - f)' P (x - f) / 2

d_p is the distance to keypoint p in deviations, f the predicted pose of the heaviest mode, or x' of
the image before while silhouette and keypoints go different ways, P the precision of the
prediction.

Reversals are the whole pose the other way round in depth, left taken for right (`body.mirror`). A
silhouette hardly tells a pose from its reversal, so a turn can be taken the wrong way round, and no
jump of a limb leads back. Where no mode of comparable weight faces one of the two ways, the best
mode is reversed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hmt_ros.body.mirror import reverse_depth
from hmt_ros.image.terms.keypoints import KeypointTerm
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.energy import Quadratic
from hmt_ros.tracking.classes import lost_a_facing
from hmt_ros.tracking.hypotheses import Hypotheses
from hmt_ros.tracking.misfit import KEYPOINTS, Misfit, of_keypoints
from hmt_ros.tracking.optimisation import Search
from hmt_ros.tracking.settings import BODY_REACH, BODY_SPEED, REVERSAL_ITERATIONS
from hmt_ros.tracking.validity import UNDECIDED, ByKeypoints


class PoseByKeypoints:
    """The pose that keypoints alone have led to since the modes left some of them.

    Attributes:
        pose: (1, d) of the last image; None: the modes explain every group of keypoints.
    """

    def __init__(self) -> None:
        self.pose: Array | None = None
        self._gain = 0.0

    def follow(
        self, search: Search, mode: Array, term: KeypointTerm, missed: Misfit
    ) -> ByKeypoints | None:
        """Goes on to the keypoints of an image.

        Args:
            search: of the image.
            mode: (d,) the heaviest.
            term: of the keypoints.
            missed: misfit of the modes to them.

        Returns:
            Misfit and gain of the pose by keypoints; None: the modes explain enough keypoints.
        """
        if not _misses_a_group(missed):
            self.pose = None
            return None
        pose = _by_keypoints(search, self.pose)
        if self.pose is None:
            both = search.posterior.body.joint_positions(np.stack([pose[0], mode]))
            self._gain = float(np.subtract(*search.continuity.rated(both)))
        self.pose = pose
        if missed.share <= UNDECIDED[KEYPOINTS]:
            return None
        gain, self._gain = self._gain, 0.0
        return ByKeypoints(of_keypoints(term, pose), gain)


def predicted_poses(search: Search, sources: Hypotheses, _rng: np.random.Generator) -> Hypotheses:
    """The means of a prediction, if there is one, each as a jump from the nearest mode."""
    if search.prediction is None:
        return sources[:0]
    poses = search.prediction.seen_as(search.posterior.person).means
    joints = search.posterior.body.joint_positions(poses)
    nearest = search.continuity.log_transitions(joints).argmax(0)
    return sources.proposed(nearest, poses, np.ones(poses.shape, dtype=np.bool_))


def keypoint_poses(search: Search, sources: Hypotheses) -> Hypotheses:
    """The pose to which keypoints alone would move the heaviest mode.

    There is one where the mode went to where it misses more than a quarter of the keypoints of a
    group: a silhouette holds limbs that have moved far since the image before. None is further than
    a person gets meanwhile: keypoints there are those of another, or the track is lost.
    """
    posterior, observation = search.posterior, search.observation
    if posterior.placing(observation) is None:
        return sources[:0]
    term = posterior.likelihood.keypoint_term(observation, None)
    if not _misses_a_group(of_keypoints(term, search.base.x[:1])):
        return sources[:0]
    pose = _by_keypoints(search, None)
    moved = np.linalg.norm(pose[:, :3] - search.continuity.predicted[:1, :3], axis=1)
    if moved[0] > BODY_REACH + BODY_SPEED * search.dt:
        return sources[:0]
    first = np.zeros(1, dtype=np.intp)
    return sources.proposed(first, pose, np.ones(pose.shape, dtype=np.bool_), expected=pose)


def reversed_poses(search: Search, sources: Hypotheses, _rng: np.random.Generator) -> Hypotheses:
    """The reversal of the best mode where a way to face is lost."""
    log_weights = search.base_rated[: len(search.modes)]
    if not lost_a_facing(search.modes.back, log_weights):
        return sources[:0]
    best = np.argsort(-log_weights, kind='stable')[:1]
    turned = reverse_depth(search.posterior.body, search.base.x[best])
    term = search.posterior.of_image(search.observation)
    moved = search.posterior.minimise(term, turned, REVERSAL_ITERATIONS).x
    return sources.proposed(best, moved, np.ones(moved.shape, dtype=np.bool_))


def _misses_a_group(missed: Misfit) -> bool:
    return bool((missed.shares[missed.counts > 0] > UNDECIDED[KEYPOINTS]).any())


def _by_keypoints(search: Search, before: Array | None) -> Array:
    """The pose x', (1, d), of an image that has keypoints."""
    posterior = search.posterior
    first = search.continuity.predicted[:1] if before is None else before
    placing = posterior.placing(search.observation)
    assert placing is not None
    term = replace(placing, motion=Quadratic(first, search.precisions[:1]))
    return posterior.minimise(term, first, posterior.settings.iterations).x
