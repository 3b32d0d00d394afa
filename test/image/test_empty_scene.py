"""The empty scene is learned from images without people, and ghosts in it are recognised."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames
from hmt_learning.rendering.scene import Scene
from hmt_ros.body.camera import Camera
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.empty_scene import (
    MIN_STILL_LOG_ODDS,
    STILL_TIME,
    UNSEEN,
    USABLE_LOG_ODDS,
    EmptyScene,
)

SECOND = 1_000_000_000
CAMERA = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope='module')
def crossing(human32):
    """Images of a person who stands and then walks aside, and the empty scene."""
    view = Viewpoint(distance=4.5)
    pose = procedural_motion('reach', human32, 0.1, 10.0, 3, viewpoint=view)[0]
    poses = np.tile(pose, (20, 1))
    poses[:, 0] += np.minimum(np.arange(20) * 0.08, 1.6) - 0.8
    scene = Scene(viewpoint=view, seed=2)
    images = [frame.image for frame in render_frames(human32, poses, CAMERA, scene)]
    return images, np.rint(scene.background(CAMERA)).astype(np.uint8)


def noisy(image, seed):
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8)


def seen_for(image, seconds, rate, scene=None, start=0):
    """The scene after `seconds` without motion, at `rate` images a second."""
    scene = scene or EmptyScene(BackgroundModel())
    for i in range(round(seconds * rate) + 1):
        scene.learn(noisy(image, i), start + round(i * SECOND / rate))
    return scene


@pytest.mark.parametrize('rate', [30.0, 8.0])
def test_how_long_it_takes_does_not_depend_on_the_rate(crossing, rate):
    empty = crossing[1]
    wanted = -USABLE_LOG_ODDS * STILL_TIME
    assert not seen_for(empty, wanted - 0.2, rate).known
    assert seen_for(empty, wanted + 0.2, rate).known
    assert seen_for(empty, 1.0, rate).log_odds == pytest.approx(-1.0 / STILL_TIME)


def test_a_scene_in_which_somebody_moves_is_not_empty(crossing):
    images, empty = crossing
    scene = EmptyScene(BackgroundModel())
    for i, image in enumerate(images * 3):
        scene.learn(noisy(image, i), i * SECOND // 10)
        assert not scene.known
    assert scene.wants == UNSEEN
    # A person who has left is not in the scene learned from then on.
    scene = seen_for(empty, 2.0, 10.0, scene, start=10 * SECOND)
    assert scene.known
    assert scene.wants == ''
    assert not scene.background.foreground(empty).any()


def test_a_detector_counts(crossing):
    images, empty = crossing
    scene = EmptyScene(BackgroundModel())
    for i in range(20):
        scene.learn(images[0], i * SECOND // 10, detected=True)
    assert not scene.background.frames
    for i in range(20, 25):
        scene.learn(noisy(empty, i), i * SECOND // 10, detected=False)
    assert scene.known


def test_a_ghost_gives_itself_away(crossing):
    """A person who kept still while the scene was learned leaves a ghost on walking away."""
    images, empty = crossing
    ghost, true = seen_for(images[0], 3.0, 10.0), seen_for(empty, 3.0, 10.0)
    assert ghost.known
    for i, image in enumerate(images[8:]):
        for scene in (ghost, true):
            scene.update(image, 4 * SECOND + i * SECOND // 10)
        if i == 0:
            # The first silhouette has no effect.
            assert not ghost.known
        assert true.known
    assert ghost.is_of_somebody
    assert true.log_odds < MIN_STILL_LOG_ODDS - 2.0


def test_what_is_given_is_neither_learned_nor_judged(crossing):
    images, empty = crossing
    given = EmptyScene(BackgroundModel.from_image(images[0]))
    shared = EmptyScene(BackgroundModel(), trusted=True)
    assert given.known
    assert not shared.known
    for scene in (given, shared):
        scene.learn(empty, 0)
        scene.update(images[5], 1)
        assert scene.log_odds == -math.inf
    assert given.background.frames == 1
    shared.background.learn(empty)
    assert shared.known
