"""How much of an image no mode explains: whether a track is lost.

    misfit = max(share of the outline's samples, share of the keypoints)

A sample or keypoint is unexplained when it is further than 4 sigmas from where it should be.
"""

from __future__ import annotations

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.likelihood import ImageLikelihood, LikelihoodSettings
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.keypoints import KeypointTerm
from hmt_ros.inference.arrays import Array

# A sample of the outline or a keypoint further away than this from where it should be is
# unexplained, in sigmas.
UNEXPLAINED = 4.0


def unexplained_share(
    body: Body,
    camera: Camera,
    poses: Array,
    observation: Observation,
    outline_costs: Array,
    settings: LikelihoodSettings,
) -> float:
    """Share of an image that the best of poses (K, d) does not explain.

    Args:
        body, camera: who is seen by what.
        poses: (K, d).
        observation: of the image.
        outline_costs: (K, M) what each sample of the outline costs each pose.
        settings: of the terms.
    """
    share = unexplained_outline(outline_costs, settings.coverage)
    if observation.keypoints is None or settings.keypoints.weight == 0:
        return share
    likelihood = ImageLikelihood(body, camera, settings)
    return max(share, unexplained_keypoints(likelihood.keypoint_term(observation, None), poses))


def unexplained_outline(costs: Array, term: TermSettings) -> float:
    """Share of the samples of the silhouette's outline that the best mode does not explain.

    Args:
        costs: (K, M) what each sample costs each mode.
        term: that they cost it by: its weight, shared among the samples, and its kernel.
    """
    if costs.size == 0:
        return 0.0
    most = 0.5 * term.weight / costs.shape[1] * term.scale**2
    limit = UNEXPLAINED**2 / (UNEXPLAINED**2 + term.scale**2)
    return float((costs > limit * most).mean(1).min())


def unexplained_keypoints(term: KeypointTerm, poses: Array) -> float:
    """Share of the keypoints that the best of poses (K, d) does not explain.

    Each pose is given the exchange of sides that is likeliest there.
    """
    shares = [1.0]
    for pose in poses:
        distances = term.distances(forward(term.skeleton, pose[None]))
        if len(distances) == 0:
            return 0.0
        shares.append(float((~(distances < UNEXPLAINED)).mean()))
    return min(shares)
