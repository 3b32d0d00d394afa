"""The pose from keypoints, which helps when limbs have left the silhouette of the last image."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.image.background import BackgroundModel
from hmt_ros.tracking import Subject, Tracker, TrackerSettings

# Number of images of a standing person, and intervals, ns.
STILL, INTERVAL, GAP = 4, 33_000_000, 400_000_000
RAISED = {'left_shoulder_x': 2.4, 'right_shoulder_x': 2.2, 'left_hip_x': 1.2, 'left_knee': 0.3}


@pytest.fixture(scope='module')
def kicked(human32, camera, motion):
    """Poses and images of a person who stands, and raises arms and a leg in the last image."""
    poses = np.repeat(motion[:1], STILL + 1, axis=0)
    rows = [human32.dof_names.index(name) for name in RAISED]
    poses[:, rows] = 0.1
    poses[-1, rows] = list(RAISED.values())
    scene = Scene(viewpoint=Viewpoint(distance=3.5), seed=2)
    images = [frame.image for frame in render_frames(human32, poses, camera, scene)]
    return poses, images, np.rint(scene.background(camera)).astype(np.uint8)


@pytest.mark.parametrize('seed', [0, 1, 2])
@pytest.mark.parametrize('gap', [INTERVAL, GAP])
def test_limbs_that_moved_far_between_two_images_are_found(
    kicked, human32, camera, keypoints_of, gap, seed
):
    poses, images, empty = kicked
    background = BackgroundModel.from_image(empty)
    tracker = Tracker(human32, camera, TrackerSettings(), background, seed)
    tracker.reset(Subject(0, keypoints_of(human32, poses[0]), dict(human32.segment_lengths)))
    stamps = [*(INTERVAL * np.arange(STILL)), INTERVAL * (STILL - 1) + gap]
    for pose, image, stamp in zip(poses, images, stamps, strict=True):
        posterior, _ = tracker.step(image, int(stamp), keypoints_of(human32, pose))
    found, true = human32.joint_positions(np.stack([posterior.means[0], poses[-1]]))
    off = np.linalg.norm(camera.project(found) - camera.project(true), axis=1)
    # Hands and foot move by up to 100 px.
    assert off.max() < 15.0
    assert np.linalg.norm(found - true, axis=1).mean() < 0.15
