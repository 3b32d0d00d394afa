"""Which limbs an image shows, and how long ago the other limbs were last visible.

A limb counts as visible up to its outermost joint with a keypoint in the image. Without keypoints,
every part of a limb inside the image counts as visible, because silhouette, edges and flow can show
it.

A leg is considered hidden, by furniture or the border of the image, if no keypoint of its joints
beyond the hip is confident. The detector then guesses from usual poses of legs, and the lack of a
silhouette of the leg is no evidence either. If the keypoints of an arm are not confident, the arm
is mostly behind the person's own trunk, where guesses are good.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.body.skeleton import Skeleton, sided_pairs
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.inference.error_model import seconds

# Confidence below which a keypoint is a guess.
MAX_GUESS_CONFIDENCE = 0.02
# Minimum confidence at which a keypoint is more likely seen than guessed.
MIN_SEEN_CONFIDENCE = 0.5
# Time without new evidence for which a limb still counts as visible, or as hidden, s.
MEMORY_TIME = 1.0
# Error of an unseen joint per bone of its limb, as a fraction of the bone's length, because
# people's bone lengths vary and a linear map is inexact within a posture.
ERROR_PER_BONE = 0.08


class UnseenLimbs:
    """Times since the segments of a person's limbs were last visible.

    Attributes:
        times: (S,) time since each segment was visible, s. 0: the last image shows the joint at the
            segment's start or a joint further out, or the segment is not in a limb. inf: never
            visible.
        hidden: (S,) segments hidden from the detector, e.g. by furniture; None if none is hidden.
    """

    def __init__(self, body: Body) -> None:
        self.times: Array = np.zeros(len(body.skeleton.parents))
        self.hidden: Mask | None = None
        self._answered = 0

    def without_guesses(
        self, body: Body, keypoints: Keypoints | None, stamp: int
    ) -> Keypoints | None:
        """The keypoints, with confidence set to 0 on hidden segments.

        Args:
            body: body of the person.
            keypoints: keypoints of an image; None if the detector gave no result. Hidden segments
                then stay hidden until `MEMORY_TIME` after the last result.
            stamp: stamp of the image, ns.
        """
        if keypoints is None:
            if seconds(stamp - self._answered) > MEMORY_TIME:
                self.hidden = None
            return None
        self._answered, hidden = stamp, hidden_segments(body.skeleton, keypoints)
        self.hidden = hidden if hidden.any() else None
        if self.hidden is None:
            return keypoints
        segments = body.skeleton.joint_segments[body.skeleton.joint_index(keypoints.names)]
        return replace(
            keypoints, confidences=np.where(hidden[segments], 0.0, keypoints.confidences)
        )

    def update(
        self, body: Body, camera: Camera, observation: Observation, pose: Array, dt: float
    ) -> None:
        """Updates the times from an image and the likeliest pose (d,) in the image.

        Args:
            dt: time since the previous image, s; inf for the first image.
        """
        shown = shown_segments(body, camera, observation, pose)
        self.times = np.where(shown, 0.0, self.times + dt)

    def of_dofs(self, body: Body) -> Array:
        """Time (d,) since the joint beyond each degree of freedom was visible, s."""
        beyond = np.arange(len(self.times))
        for chain in body.chains.values():
            beyond[list(chain[:-1])] = chain[1:]
        times = self.times[beyond]
        times[list(body.skeleton.spine)], times[0] = self.times[0], 0.0
        return times[body.skeleton.dof_segments]

    def shown_joints(self, body: Body) -> Mask:
        """Mask (J,) of the joints that were visible within the last `MEMORY_TIME`."""
        return np.asarray(self.times[body.skeleton.joint_segments] < MEMORY_TIME)

    def with_larger_errors(self, body: Body) -> Body:
        """The body with larger errors of unseen joints: lengths vary, and joints move on arcs."""
        hidden = self.times > 0.0
        return _with_larger_errors(body, tuple(hidden.tolist())) if hidden.any() else body


@lru_cache(maxsize=8)
def _with_larger_errors(body: Body, hidden: tuple[bool, ...]) -> Body:
    skeleton, away = body.skeleton, np.zeros(len(hidden))
    for chain in body.chains.values():
        own = list(chain[1:])
        away[own] = np.cumsum((skeleton.offsets[own] ** 2).sum(1))
    more = ERROR_PER_BONE**2 * (away * hidden)[skeleton.joint_segments]
    return body.with_beliefs(joint_errors=np.sqrt(body.joint_errors**2 + more))


def hidden_segments(skeleton: Skeleton, keypoints: Keypoints) -> Mask:
    """Mask (S,) of leg segments beyond the thigh that are hidden from a detector."""
    hidden = np.zeros(len(skeleton.parents), dtype=np.bool_)
    segments = skeleton.joint_segments[skeleton.joint_index(keypoints.names)]
    sure = keypoints.seen & (keypoints.confidences >= MIN_SEEN_CONFIDENCE)
    for own in skeleton.chains.values():
        beyond = np.isin(segments, own[1:])
        if skeleton.parents[own[0]] == 0 and beyond.any() and not sure[beyond].any():
            hidden[list(own[1:])] = True
    return hidden


def shown_segments(body: Body, camera: Camera, observation: Observation, pose: Array) -> Mask:
    """Whether each segment (S,) is visible in an image at a pose (d,), see `UnseenLimbs.times`."""
    skeleton, keypoints = body.skeleton, observation.keypoints
    if keypoints is None:
        origins = forward(skeleton, pose[None]).segments[1][0]
        shown = _inside(camera, camera.project(origins))
    else:
        found = _inside(camera, keypoints.pixels) & (keypoints.confidences >= MAX_GUESS_CONFIDENCE)
        joints = skeleton.joint_index(tuple(keypoints.names[i] for i in np.flatnonzero(found)))
        shown = np.zeros(len(skeleton.parents), dtype=np.bool_)
        shown[skeleton.joint_segments[joints]] = True
    by = _showing(skeleton)
    return np.asarray((by & shown).any(1) | ~by.any(1))


@lru_cache(maxsize=16)
def _showing(skeleton: Skeleton) -> Mask:
    """Mask (S, S) of the columns that make a row's segment visible; empty: always visible."""
    result = np.zeros((len(skeleton.parents),) * 2, dtype=np.bool_)
    for chain in (chain for pair in sided_pairs(skeleton.chains) for chain in pair):
        outwards = list(skeleton.chains[chain])
        for place, segment in enumerate(outwards):
            result[segment, outwards[place:]] = True
    # A visible leg makes the pelvis visible.
    hung = [own[0] for own in skeleton.chains.values() if skeleton.parents[own[0]] == 0]
    if result[hung].any(1).all():
        result[0] = result[hung].any(0)
    return result


def _inside(camera: Camera, pixels: Array) -> Mask:
    """Whether each of the pixels (N, 2) lies in the image."""
    ends = camera.width - 0.5, camera.height - 0.5
    return np.asarray(((pixels >= -0.5) & (pixels < ends)).all(1))
