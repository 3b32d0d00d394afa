"""The warm-up of sessions before the first message, so that no message waits for compiled code.

numba compiles a kernel, or loads its compiled code, at its first call. A short film, and mixtures
as if of one, run all of them; only the compiled code is kept (`Session.prepare`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from hmt_ros.body import Body, Camera, load_body
from hmt_ros.body.keep_out import keep_out_capsules
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.person_shape import covered
from hmt_ros.image.terms.depth import usable_depths
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.tracking import KnownGround, Subject, Tracker
from msg_tools import RosbagsMessages
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message

IMAGES, RATE, DISTANCE = 5, 10.0, 3.5


class Film(NamedTuple):
    """Somebody before a grey wall, and a camera that stands still.

    Attributes:
        body, camera: the person, and the camera that sees the person.
        empty: (H, W, 3) the wall.
        poses: (T, d).
        images, masks: T of (H, W, 3) and (H, W).
    """

    body: Body
    camera: Camera
    empty: Image
    poses: Array
    images: list[Image]
    masks: list[Mask]

    def keypoints(self, t: int) -> Keypoints:
        """All joints in image t, as a detector sees them."""
        pixels = self.camera.project(self.body.joint_positions(self.poses[t : t + 1]))[0]
        n = len(pixels)
        return Keypoints(self.body.joint_names, pixels, np.tile(np.eye(2), (n, 1, 1)), np.ones(n))


@lru_cache(maxsize=1)
def film() -> Film:
    """The film, of 240 x 180 px, drawn of hulls: a renderer would take longer than all the rest."""
    body, camera = load_body('human37'), Camera(220.0, 220.0, 119.5, 89.5, 240, 180)
    empty = np.random.default_rng(0).integers(120, 140, (180, 240, 3), dtype=np.uint8)
    poses = np.tile(body.prior_mean, (IMAGES, 1)) + 0.02 * np.arange(IMAGES)[:, None]
    poses[:, 2] = DISTANCE
    masks = [covered(body, camera, pose) for pose in poses]
    clothes = np.array((40, 60, 80), np.uint8)
    images = [np.where(mask[:, :, None], clothes, empty) for mask in masks]
    return Film(body, camera, empty, poses, images, masks)


@lru_cache(maxsize=1)
def warm_up_tracking() -> None:
    """Tracks from keypoints over a known floor, and with depth images from a subject."""
    shown = film()
    body, camera = shown.body, shown.camera
    tracker = Tracker(body, camera, known_ground=KnownGround(np.array([0.0, -1.0, 0.0]), 1.0))
    other = Tracker(body, camera, background=BackgroundModel.from_image(shown.empty))
    other.reset(Subject(_stamp(0), shown.keypoints(0), dict(body.segment_lengths)))
    for t, (image, mask) in enumerate(zip(shown.images, shown.masks, strict=True)):
        tracker.step(image, _stamp(t), shown.keypoints(t))
        depth = np.where(mask, DISTANCE, 2.0 * DISTANCE).astype(np.float32)
        other.step(image, _stamp(t), depth=usable_depths(depth))
    keep_out_capsules(tracker.estimate.body, tracker.estimate.posterior)


def likelihoods(body: Body) -> list[Any]:
    """hmt_msgs/PoseMixture of two modes that move, as likelihoods of the filter."""
    messages, made = RosbagsMessages(), []
    for t in range(IMAGES):
        means = np.stack([body.prior_mean + 0.01 * t, body.prior_mean - 0.05])
        covariances = np.tile(1e-3 * np.eye(body.dimension), (2, 1, 1))
        content = PoseMixture.of_body(
            body,
            GaussianMixture(np.array([0.6, 0.4]), means, covariances),
            MixtureKind.LIKELIHOOD,
            _stamp(t),
            '',
            error_share=0.5,
            error_time=0.1,
            identities=np.array([1, 2]),
            posterior_weights=np.array([0.6, 0.4]),
            ancestry=np.array([[0.9, 0.1], [0.2, 0.8]])[:, : 2 * (t > 0)],
            ancestry_stamp_ns=_stamp(t - 1) if t else 0,
            ancestry_ids=np.array([1, 2][: 2 * (t > 0)]),
        )
        made.append(pose_mixture_message(messages, content))
    return made


def _stamp(t: int) -> int:
    return round((1.0 + t / RATE) * SECOND_NS)
