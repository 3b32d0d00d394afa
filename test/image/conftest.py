"""Two images of a rendered person, which the tests of `image` share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Body, Camera, load_body

VIEW = Viewpoint(distance=3.2)


@dataclass(frozen=True, eq=False)
class Shot:
    """Two images of a person, 0.1 s apart: poses (2, d), images, true silhouettes."""

    body: Body
    camera: Camera
    poses: np.ndarray
    images: list[np.ndarray]
    masks: list[np.ndarray]
    background: np.ndarray

    def near(self, count: int, seed: int, spread: float = 0.1) -> Any:
        """Poses (count, d) around the second one."""
        rng = np.random.default_rng(seed)
        pose = self.poses[1]
        poses = pose + spread * rng.normal(size=(count, len(pose)))
        poses[:, :3] = pose[:3] + 0.3 * spread * rng.normal(size=(count, 3))
        return np.clip(poses, self.body.lower, self.body.upper)


@pytest.fixture(scope='session')
def shot() -> Shot:
    body = load_body('human37')
    camera = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)
    poses = procedural_motion('walk', body, 0.8, 10.0, 3, viewpoint=VIEW)[4:6]
    scene = Scene(viewpoint=VIEW, seed=2)
    frames = list(render_frames(body, poses, camera, scene))
    empty = np.rint(scene.background(camera)).astype(np.uint8)
    return Shot(body, camera, poses, [f.image for f in frames], [f.mask for f in frames], empty)
