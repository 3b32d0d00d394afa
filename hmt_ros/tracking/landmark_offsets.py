"""Landmark offsets of one person, learned while other cues locate the person.

    pixel_l = project(J_l + R_l (o_l + d_l)) + e,     d_l ~ N(0, OFFSET_SIGMA^2)

o_l is the usual offset of landmark l in the frame of its segment, R_l, and d_l the deviation due to
person, clothes and detector. Errors of a keypoint persist for seconds, so at most `MAX_RATE` images
per second are counted. Keypoints alone cannot distinguish an offset from a pose, so edges or
silhouettes are required, too.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import product, solve

# Standard deviations of an offset d_l, and of a keypoint's error at the person's distance, m.
OFFSET_SIGMA, KEYPOINT_SIGMA = 0.02, 0.03
# Scale of the robust kernel, m; minimum confidence of a keypoint; effective images per second.
KERNEL_SCALE, MIN_CONFIDENCE, MAX_RATE = 0.06, 0.5, 4.0


@dataclass(frozen=True, eq=False)
class LandmarkOffsets:
    """Estimate of the offsets of a person's landmarks.

    Attributes:
        landmarks: names of n landmarks; empty if unknown.
        precision: (n, 3, 3) precisions of the offsets, 1/m^2.
        pull: (n, 3) precisions times offsets, 1/m.
    """

    landmarks: tuple[str, ...] = ()
    precision: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    pull: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @cached_property
    def offsets(self) -> Array:
        """Most probable offsets (n, 3), m."""
        known = self.precision + np.eye(3) / OFFSET_SIGMA**2
        return np.asarray(solve(known, self.pull[..., None])[..., 0])

    def applied(self, keypoints: Keypoints | None) -> Keypoints | None:
        """Returns keypoints with the offsets of this person added."""
        if keypoints is None or keypoints.offsets is None or keypoints.landmarks != self.landmarks:
            return keypoints
        return replace(keypoints, offsets=keypoints.offsets + self.offsets)

    def after(
        self, keypoints: Keypoints, body: Body, camera: Camera, pose: Array, dt: float
    ) -> LandmarkOffsets:
        """Returns the estimate updated by an image.

        Args:
            keypoints: keypoints of the image, as returned by `applied`.
            body, pose: body, and its pose (d,) according to all cues.
            dt: time since the previous image, s.
        """
        if keypoints.landmarks is None or keypoints.offsets is None:
            return self
        known, n = self, len(keypoints.names)
        if keypoints.landmarks != self.landmarks:
            known = LandmarkOffsets(keypoints.landmarks, np.zeros((n, 3, 3)), np.zeros((n, 3)))
        which = body.skeleton.joint_index(keypoints.names)
        segments = body.skeleton.joint_segments[which]
        frames = forward(body.skeleton, pose[None])
        places = frames.places(segments, body.skeleton.joint_offsets[which] + keypoints.offsets)[0]
        seen = keypoints.seen & (keypoints.confidences > MIN_CONFIDENCE) & (places[:, 2] > 0)
        if not seen.any():
            return known
        pixels, slopes = camera.project_with_derivative(places[seen].T)
        size = np.array([camera.magnification(z) for z in places[seen, 2].tolist()])
        slopes = product(slopes.transpose(2, 0, 1), frames.rotations()[0, segments[seen]])
        slopes = slopes / size[:, None, None]
        errors = (keypoints.pixels[seen] - pixels.T) / size[:, None]
        weights = min(MAX_RATE * dt, 1.0) / KEYPOINT_SIGMA**2
        weights = weights / (1.0 + np.square(errors).sum(1) / KERNEL_SCALE**2) ** 2
        by_weight = weights[:, None, None] * slopes
        precision, pull = known.precision.copy(), known.pull.copy()
        information = product(by_weight.transpose(0, 2, 1), slopes)
        precision[seen] += information
        pull[seen] += np.einsum('nab,na->nb', by_weight, errors)
        pull[seen] += product(information, known.offsets[seen][..., None])[..., 0]
        return LandmarkOffsets(known.landmarks, precision, pull)
