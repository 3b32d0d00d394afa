"""Invariants of every leaf, at poses drawn by hypothesis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from hmt_ros.body import Body, load_body
from hmt_ros.flips.interpretation_tree import enumerate_flips

BODY = load_body('human34')
NAMES = BODY.dof_names
LIMITED = np.minimum(BODY.upper, np.pi) - np.maximum(BODY.lower, -np.pi)
TURNS = BODY.skeleton.dof_is_rotation
ARM = ('left_shoulder', 'left_elbow', 'left_wrist', 'left_hand')
# The body without joint limits.
FREE = replace(
    BODY,
    skeleton=replace(
        BODY.skeleton,
        lower=np.where(TURNS, -np.pi, BODY.lower),
        upper=np.where(TURNS, np.pi, BODY.upper),
    ),
)


@st.composite
def poses(draw, fixed=()):
    """Poses within the limits, 2 to 5 m in front of the camera; some angles can be given."""
    share = np.array(draw(st.lists(st.floats(0, 1), min_size=34, max_size=34)))
    pose = np.where(TURNS, np.maximum(BODY.lower, -np.pi) + share * LIMITED, share - 0.5)
    pose[2] += 3.5
    pose = np.clip(pose, BODY.lower, BODY.upper)  # rounding
    for name, value in dict(fixed).items():
        pose[NAMES.index(name)] = value
    # A joint of a valid pose may still be behind the camera, without an image.
    assume((BODY.joint_positions(pose[None])[..., 2] > 0.1).all())
    return pose


def bones(body: Body, found):
    """Lengths of the bones, without that from pelvis to neck, which the trunk changes."""
    joints, neck = body.joint_positions(found), body.joint_names.index('neck')
    rigid = [(a, b) for a, b in body.skeleton.bones if (body.joint_names[a], b) != ('pelvis', neck)]
    return np.stack([np.linalg.norm(joints[:, a] - joints[:, b], axis=1) for a, b in rigid])


def off_rays(found, pose, names=None):
    """Distances (N, J) of joints from the rays of those of a pose."""
    seen, joints = BODY.joint_positions(pose[None]), BODY.joint_positions(found)
    if names is not None:
        which = BODY.skeleton.joint_index(names)
        seen, joints = seen[:, which], joints[:, which]
    rays = seen / np.linalg.norm(seen, axis=2, keepdims=True)
    return np.linalg.norm(np.cross(joints, rays), axis=2)


def faults_of(pose, found):
    """Violated invariants: image, lengths, limits, and that the pose is one of its leaves."""
    holds = {
        'pose': np.abs(found - pose).max(1).min() == 0.0,
        'lengths': np.abs(bones(BODY, found) - bones(BODY, pose[None])).max() < 1e-9,
        'lower limits': (found >= BODY.lower).all(),
        'upper limits': (found <= BODY.upper).all(),
        # Near a straight limb, angles are determined only to the square root of rounding errors.
        'image': off_rays(found, pose).max() < 1e-6,
    }
    return [name for name, ok in holds.items() if not ok]


@pytest.mark.parametrize('kind', ['left_arm', 'right_leg', 'neck'])
@settings(max_examples=40, deadline=None)
@given(pose=poses())
def test_image_lengths_and_limits_hold_for_every_leaf(kind, pose):
    assert not faults_of(pose, enumerate_flips(BODY, pose, kind)[0])


@settings(max_examples=20, deadline=None)
@given(pose=poses(fixed={'left_elbow': 0.0}))
def test_straight_elbow(pose):
    """The free twist of the upper arm is unchanged, or determined by the hand."""
    assert not faults_of(pose, enumerate_flips(BODY, pose, 'left_arm')[0])


@settings(max_examples=20, deadline=None)
@given(
    pose=poses(
        fixed={'left_elbow': 0.0, 'left_wrist_x': 0.0, 'left_wrist_y': 0.0, 'left_shoulder_z': 0.4}
    )
)
def test_straight_arm(pose):
    """With elbow and hand in line, no joint determines the twist."""
    found, _ = enumerate_flips(BODY, pose, 'left_arm')
    assert not faults_of(pose, found)
    straight = np.abs(found[:, NAMES.index('left_elbow')]) < 1e-9
    assert straight.any()


@settings(max_examples=20, deadline=None)
@given(pose=poses(), sign=st.sampled_from([-1.0, 1.0]))
def test_gimbal(pose, sign):
    """cos b = 0 at the shoulder, where the first and the third angle turn about one axis."""
    wide = NAMES.index('left_shoulder_y')
    pose[wide] = np.clip(sign * np.pi / 2, BODY.lower[wide], BODY.upper[wide])
    assume((BODY.joint_positions(pose[None])[..., 2] > 0.1).all())
    assert not faults_of(pose, enumerate_flips(BODY, pose, 'left_arm')[0])


def test_gimbal_itself():
    """The upper arm lies exactly along the axis of its first angle, with limits that allow it."""
    pose = np.array(BODY.prior_mean)
    pose[2] = 3.0
    pose[NAMES.index('left_shoulder_y')] = np.pi / 2
    pose[NAMES.index('left_shoulder_x')] = 0.7
    found = enumerate_flips(FREE, pose, 'left_arm')[0]
    assert len(found) >= 2
    assert np.isfinite(found).all()
    assert off_rays(found, pose).max() < 1e-6
    upright = np.abs(np.cos(found[:, NAMES.index('left_shoulder_y')])) < 1e-6
    assert np.allclose(found[upright, NAMES.index('left_shoulder_x')], 0.7)


def test_ray_that_misses():
    """A flipped parent takes the child's ray away from its sphere: that branch has no leaves."""
    pose = np.array(BODY.prior_mean)
    pose[2] = 3.0
    rng = np.random.default_rng(0)
    missed = 0
    arm = BODY.skeleton.chain_dofs['left_arm']
    for _ in range(200):
        pose[arm] = rng.uniform(BODY.lower[arm], BODY.upper[arm])
        places = BODY.joint_positions(pose[None])[0, BODY.skeleton.joint_index(ARM)]
        start, elbow, wrist, _ = places
        ray = elbow / np.linalg.norm(elbow)
        other = 2 * (start @ ray) * ray - elbow  # the elbow's other place on its ray
        ray = wrist / np.linalg.norm(wrist)
        reach = np.linalg.norm(wrist - elbow)
        if np.linalg.norm(other - (other @ ray) * ray) <= reach:
            continue
        missed += 1
        found = enumerate_flips(BODY, pose, 'left_arm')[0]
        elbows = BODY.joint_positions(found)[:, BODY.skeleton.joint_index(['left_elbow'])[0]]
        assert np.abs(elbows - elbow).max() < 1e-6
        assert off_rays(found, pose).max() < 1e-6
    assert missed > 10


def test_joint_behind_the_camera():
    """If the camera is inside a link's sphere, one of two solutions is behind it: no leaf."""
    rng = np.random.default_rng(1)
    which = BODY.skeleton.joint_index(ARM)
    inside = 0
    for _ in range(400):
        pose = rng.uniform(FREE.lower, FREE.upper)
        pose[:3] = *rng.uniform(-0.3, 0.3, 2), 0.4
        places = FREE.joint_positions(pose[None])[:, which]
        if places[..., 2].min() < 0.01:
            continue
        inside += np.linalg.norm(places[0, 0]) < np.linalg.norm(places[0, 1] - places[0, 0])
        found = FREE.joint_positions(enumerate_flips(FREE, pose, 'left_arm')[0])[:, which]
        assert ((found * places).sum(2) > 0).all()
        if np.linalg.norm(places[0, 0]) < np.linalg.norm(places[0, 1] - places[0, 0]):
            assert len(found) <= 4
    assert inside > 5
