"""A small body, a camera, a motion in front of it, keypoints, films and modes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Body, Camera
from hmt_ros.image.terms.keypoints import Keypoints

KeypointsOf = Callable[..., Keypoints]
Filmed = Callable[..., tuple[np.ndarray, list[np.ndarray], np.ndarray]]


@pytest.fixture(scope='session')
def camera() -> Camera:
    return Camera(330.0, 330.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope='session')
def motion(human32) -> np.ndarray:
    """Poses (12, 32) of a person who reaches for things, 10 Hz."""
    return procedural_motion('reach', human32, 1.2, 10.0, 3, viewpoint=Viewpoint(distance=3.5))


@pytest.fixture(scope='session')
def keypoints_of(camera) -> KeypointsOf:
    """Function (body, pose, sigma, seed) -> all joints as a detector sees them; sigma in px."""

    def see(body: Body, pose: np.ndarray, sigma: float = 1.0, seed: int = 0) -> Keypoints:
        pixels = camera.project(body.joint_positions(pose[None]))[0]
        n = len(pixels)
        noise = sigma * np.random.default_rng(seed).normal(size=(n, 2))
        covariances = np.tile(sigma**2 * np.eye(2), (n, 1, 1))
        return Keypoints(body.joint_names, pixels + noise, covariances, np.ones(n))

    return see


@pytest.fixture(scope='session')
def filmed(human32) -> Filmed:
    """Function (motion, seconds, camera, every) -> poses at 10 Hz, images and the empty scene."""

    def film(motion: str, seconds: float, camera: Camera, every: int = 1):
        view = Viewpoint(distance=3.2)
        poses = procedural_motion(motion, human32, seconds, 10.0, 3, viewpoint=view)[::every]
        scene = Scene(viewpoint=view, seed=2)
        images = [frame.image for frame in render_frames(human32, poses, camera, scene)]
        return poses, images, np.rint(scene.background(camera)).astype(np.uint8)

    return film


@pytest.fixture(scope='session')
def modes(human32) -> tuple[np.ndarray, np.ndarray]:
    """Means (2, d) in the middle of the limits and correlated covariances (2, d, d)."""
    d = human32.dimension
    rng = np.random.default_rng(0)
    means = np.tile(0.5 * (human32.lower + human32.upper), (2, 1))
    root = rng.normal(size=(2, d, d)) * np.array([0.02, 0.05])[:, None, None] / np.sqrt(d)
    scales = np.exp(rng.normal(0, 0.5, (2, d)))
    root = scales[:, :, None] * root
    return means, root @ root.transpose(0, 2, 1) + 1e-6 * np.eye(d)
