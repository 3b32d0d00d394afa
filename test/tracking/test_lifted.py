"""Experts that know depth, in the tracker: their inputs and their effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_learning.training.training_set import procedural_sequence
from hmt_ros.body import Camera, load_body
from hmt_ros.image.lifted_poses import HIPS
from hmt_ros.image.likelihood import OFF
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.terms.registry import TERMS
from hmt_ros.tracking import Tracker, TrackerSettings

BODY, CAMERA = load_body('human37'), Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
BLANK = np.full((480, 640, 3), 128, np.uint8)
STEP = 33_333_333


def settings(**values):
    usual = TrackerSettings(evaluation_budget=100, flow_weight=0.0, threads=1)
    off = {term.name: OFF for term in TERMS}
    return replace(usual, likelihood=replace(usual.likelihood, **off), **values)


@pytest.fixture(scope='module')
def walk():
    """Poses and keypoints of a walking person."""
    poses = procedural_sequence('walk', BODY, 1.0, 0).poses[:10].copy()
    poses[:, :3] += np.array([0.1, 0.1, 4.0]) - poses[0, :3]
    joints = BODY.joint_positions(poses)
    n = joints.shape[1]
    noise = np.tile(4.0 * np.eye(2), (n, 1, 1))
    seen = [Keypoints(BODY.joint_names, CAMERA.project(x), noise, np.ones(n)) for x in joints]
    return poses, joints, seen


def observed(tracker, monkeypatch):
    """The keypoints that a tracker receives, image by image."""
    seen, observer = [], tracker._observer
    view = observer.view

    def spy(given, *arguments):
        seen.append(given.keypoints)
        return view(given, *arguments)

    monkeypatch.setattr(observer, 'view', spy)
    return seen


def test_keypoints_get_what_experts_say(walk, monkeypatch):
    _, _, seen = walk
    tracker = Tracker(BODY, CAMERA, settings(), seed=0)
    given = observed(tracker, monkeypatch)
    for t in range(3):
        tracker.step(BLANK, t * STEP, seen[t])
    assert all(one.lifted is not None for one in given)
    assert len(given[0].lifted.log_weights) == 5


def test_a_guess_in_space_is_pooled_with_them(walk, monkeypatch):
    _, joints, seen = walk
    hips = BODY.skeleton.joint_index(HIPS)
    guess = joints[0] - joints[0, hips].mean(0)
    alone = Tracker(BODY, CAMERA, settings(lifter=''), seed=0)
    given = observed(alone, monkeypatch)
    alone.step(BLANK, 0, replace(seen[0], positions=guess))
    assert len(given[0].lifted.log_weights) == 1
    both = Tracker(BODY, CAMERA, settings(), seed=0)
    given = observed(both, monkeypatch)
    both.step(BLANK, 0, replace(seen[0], positions=guess))
    assert np.exp(given[0].lifted.log_weights).sum() == pytest.approx(1.0)
    assert len(given[0].lifted.log_weights) == 6
    assert np.exp(given[0].lifted.log_weights[-1]) == pytest.approx(0.5)


def test_a_true_guess_tells_towards_from_away(walk):
    """Depths of a pose decide which way a limb points where keypoints leave it open."""
    _, joints, seen = walk
    hips = BODY.skeleton.joint_index(HIPS)
    guesses = [x - x[hips].mean(0) for x in joints]
    errors = {}
    for name in ('without', 'with'):
        tracker = Tracker(BODY, CAMERA, settings(lifter=''), seed=0)
        for t in range(6):
            told = replace(seen[t], positions=guesses[t] if name == 'with' else None)
            tracker.step(BLANK, t * STEP, told)
        found = tracker.estimate.body.joint_positions(tracker.estimate.modes.poses[:1])[0]
        off = (found - found[hips].mean(0)) - guesses[5]
        errors[name] = float(np.linalg.norm(off, axis=1).mean())
    assert errors['with'] < 0.06
    assert errors['with'] <= errors['without'] + 0.005


def test_a_mixture_that_is_wrong_costs_little(walk):
    """A mixture that turns everybody around does not prevail over the keypoints' own poses."""
    _, joints, seen = walk
    hips = BODY.skeleton.joint_index(HIPS)
    tracker = Tracker(BODY, CAMERA, settings(lifter=''), seed=0)
    far = np.random.default_rng(0).normal(size=joints[0].shape) * 2.0
    far[hips] = 0.01
    for t in range(4):
        tracker.step(BLANK, t * STEP, replace(seen[t], positions=far))
    found = tracker.estimate.body.joint_positions(tracker.estimate.modes.poses[:1])[0]
    off = np.linalg.norm(CAMERA.project(found) - seen[3].pixels, axis=1)
    assert np.median(off) < 6.0
