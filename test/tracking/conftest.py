"""A small body, a camera, a motion before it and its joints in the image."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from hmt_ros.body import Body, Camera, load_body
from hmt_ros.body.procedural_motion import procedural_motion
from hmt_ros.body.viewpoint import Viewpoint
from hmt_ros.image.observation import Keypoints

KeypointsOf = Callable[..., Keypoints]


@pytest.fixture(scope='session')
def human32() -> Body:
    return load_body('human32')


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
