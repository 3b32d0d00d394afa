"""The limbs that are searched for in an image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.image.observation import Beliefs, Observation
from hmt_ros.image.terms.image_term import TermSettings
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import TrackerSettings
from hmt_ros.tracking.posterior import Posterior
from hmt_ros.tracking.proposals.kinematic_jumps import limbs_not_shown

BODY = load_body('human37')
CAMERA = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)
LIMBS = {'left_arm', 'right_arm', 'left_leg', 'right_leg'}
SHAPE = {'edges': object()}


def searched_for(observation, *, surprising=False, settings=None):
    """The limbs that are searched for in an image."""
    posterior = Posterior(BODY, CAMERA, settings or TrackerSettings())
    return set(limbs_not_shown(posterior, observation, surprising))


def seen(*names):
    """Keypoints of all joints, seen at some alone."""
    pose = np.zeros((1, BODY.dimension))
    pose[0, 2] = 3.0
    pixels = CAMERA.project(BODY.joint_positions(pose))[0]
    confidences = np.array([float(name in names) for name in BODY.joint_names])
    covariances = np.tile(np.eye(2), (len(pixels), 1, 1))
    return Keypoints(BODY.joint_names, pixels, covariances, confidences)


LEGS = [f'{side}_{name}' for side in ('left', 'right') for name in ('knee', 'ankle')]


@pytest.mark.parametrize(
    ('keypoints', 'searched'),
    [
        (None, LIMBS),
        (seen(), LIMBS),
        (seen(*BODY.joint_names), set()),
        (seen(*LEGS), {'left_arm', 'right_arm'}),
        (seen(*LEGS[:3]), LIMBS - {'left_leg'}),
    ],
)
def test_an_image_is_searched_for_limbs_that_no_keypoints_show(keypoints, searched):
    observation = Observation(keypoints=keypoints, evidence=SHAPE)
    assert searched_for(observation) == searched


def test_keypoints_that_are_not_believed_show_nothing():
    every = Observation(keypoints=seen(*BODY.joint_names), evidence=SHAPE)
    observation = replace(every, beliefs=Beliefs(1.0, np.array([1.0, 0.1, 0.9]), 1.0))
    assert searched_for(observation) == {'left_arm', 'right_arm'}
    # Neither do the keypoints of a surprising image.
    assert searched_for(every, surprising=True) == LIMBS
    usual = TrackerSettings()
    off = replace(usual.likelihood, keypoints=TermSettings(0.0, 1.0, 3.0))
    assert searched_for(every, settings=replace(usual, likelihood=off)) == LIMBS
