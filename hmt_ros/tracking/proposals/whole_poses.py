"""Proposals of whole poses: predicted poses, poses fitted to keypoints alone, and reversals.

Pose hypotheses from an external single-image predictor, such as a mixture of experts, are proposals
and not evidence, because the image would then be counted twice.

Poses fitted to keypoints alone help when a wrong silhouette draws the modes away from the
keypoints:

    x' = argmin sum_p d_p(x)^2 / 2 + E_prior(x) + (x - f)' P (x - f) / 2

d_p is the distance to keypoint p in standard deviations; f is the predicted pose of the heaviest
mode, or, while silhouette and keypoints disagree, x' of the previous image; P is the precision of
the prediction.

A reversal is the whole pose reversed in depth, with left and right exchanged (`body.mirror`). A
silhouette hardly distinguishes a pose from its reversal, so a track may follow a turn in the wrong
direction, which no jump of a limb corrects. If one of the two facing directions has no mode of
comparable weight, the best mode is reversed.
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
from hmt_ros.tracking.validity import UNDECIDED_MISFITS, ByKeypoints


class PoseByKeypoints:
    """Pose fitted to keypoints alone, updated while the modes miss a group of keypoints.

    Attributes:
        pose: (1, d) pose in the last image; None: the modes explain every group of keypoints.
    """

    def __init__(self) -> None:
        self.pose: Array | None = None
        self._gain = 0.0

    def follow(
        self, search: Search, mode: Array, term: KeypointTerm, missed: Misfit
    ) -> ByKeypoints | None:
        """Updates the pose from the keypoints of an image.

        Args:
            search: inputs and optima of the image.
            mode: (d,) pose of the heaviest mode.
            term: energy term of the keypoints.
            missed: misfit of the modes to the keypoints.

        Returns:
            Misfit and gain of the pose; None if the modes explain enough keypoints.
        """
        if not _misses_a_group(missed):
            self.pose = None
            return None
        pose = _by_keypoints(search, self.pose)
        if self.pose is None:
            both = search.posterior.body.joint_positions(np.stack([pose[0], mode]))
            self._gain = float(np.subtract(*search.transition_prior.log_predictive(both)))
        self.pose = pose
        if missed.share <= UNDECIDED_MISFITS[KEYPOINTS]:
            return None
        gain, self._gain = self._gain, 0.0
        return ByKeypoints(of_keypoints(term, pose), gain)


def predicted_poses(search: Search, sources: Hypotheses, _rng: np.random.Generator) -> Hypotheses:
    """Proposes the mean poses of a prediction, each as a jump from its nearest mode."""
    if search.prediction is None:
        return sources[:0]
    poses = search.prediction.seen_as(search.posterior.person).means
    joints = search.posterior.body.joint_positions(poses)
    nearest = search.transition_prior.log_transitions(joints).argmax(0)
    return sources.proposed(nearest, poses, np.ones(poses.shape, dtype=np.bool_))


def keypoint_poses(search: Search, sources: Hypotheses) -> Hypotheses:
    """Proposes a pose fitted to keypoints alone if the heaviest mode misses too many of them.

    The optimum of the mode must miss more than a quarter of the keypoints of a group, as happens if
    the silhouette holds back limbs that have moved far since the previous image. The pose is
    dropped if the person cannot have moved there, because then the keypoints belong to another
    person, or the track is lost.
    """
    posterior, observation = search.posterior, search.observation
    if posterior.placing(observation) is None:
        return sources[:0]
    term = posterior.likelihood.keypoint_term(observation, None)
    if not _misses_a_group(of_keypoints(term, search.base.x[:1])):
        return sources[:0]
    pose = _by_keypoints(search, None)
    moved = np.linalg.norm(pose[:, :3] - search.transition_prior.predicted[:1, :3], axis=1)
    if moved[0] > BODY_REACH + BODY_SPEED * search.dt:
        return sources[:0]
    first = np.zeros(1, dtype=np.intp)
    return sources.proposed(first, pose, np.ones(pose.shape, dtype=np.bool_), expected=pose)


def reversed_poses(search: Search, sources: Hypotheses, _rng: np.random.Generator) -> Hypotheses:
    """Proposes the reversed best mode if a facing direction has no mode of comparable weight."""
    log_weights = search.base_rated[: len(search.modes)]
    if not lost_a_facing(search.modes.back, log_weights):
        return sources[:0]
    best = np.argsort(-log_weights, kind='stable')[:1]
    turned = reverse_depth(search.posterior.body, search.base.x[best])
    term = search.posterior.of_image(search.observation)
    moved = search.posterior.minimise(term, turned, REVERSAL_ITERATIONS).x
    return sources.proposed(best, moved, np.ones(moved.shape, dtype=np.bool_))


def _misses_a_group(missed: Misfit) -> bool:
    return bool((missed.shares[missed.counts > 0] > UNDECIDED_MISFITS[KEYPOINTS]).any())


def _by_keypoints(search: Search, before: Array | None) -> Array:
    """Fits the pose x' (1, d) to the keypoints of an image."""
    posterior = search.posterior
    first = search.transition_prior.predicted[:1] if before is None else before
    placing = posterior.placing(search.observation)
    assert placing is not None
    term = replace(placing, motion=Quadratic(first, search.precisions[:1]))
    return posterior.minimise(term, first, posterior.settings.iterations).x
