"""Visible limbs of an image, from keypoints or from the image borders."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.unseen_limbs import UnseenLimbs


@pytest.fixture(scope='module')
def body():
    return load_body('human37')


@pytest.fixture(scope='module')
def pose(body):
    """Pose of a person who stands 3 m away."""
    result = body.prior_mean.copy()
    result[2] = 3.0
    return result


def camera_to(row):
    """A camera whose images end at a row."""
    return Camera(330.0, 330.0, 159.5, 119.5, 320, row)


def keypoints(body, pose, without=(), confidence=1.0):
    pixels = camera_to(240).project(body.joint_positions(pose[None]))[0]
    gone = np.array([any(x in name for x in without) for name in body.joint_names])
    pixels[gone] = np.nan
    n = len(pixels)
    return Keypoints(
        body.joint_names, pixels, np.tile(np.eye(2), (n, 1, 1)), np.where(gone, 0.0, confidence)
    )


def unseen_after(body, pose, camera, observation):
    limbs = UnseenLimbs(body)
    limbs.update(body, camera, observation, pose, np.inf)
    return {x for x, t in zip(body.dof_names, limbs.of_dofs(body), strict=True) if t > 0}


SHINS = ('left_knee', 'right_knee', 'left_ankle', 'right_ankle')


@pytest.mark.parametrize(
    ('without', 'names'),
    [
        ((), set()),
        (('ankle', 'toe'), set(SHINS)),
        (('left_wrist', 'left_hand'), {'left_elbow', 'left_wrist'}),
        (('toe', 'hand'), set()),
        (('elbow',), set()),
    ],
)
def test_a_limb_is_shown_as_far_out_as_it_has_keypoints(body, pose, without, names):
    seen = Observation(keypoints=keypoints(body, pose, without))
    found = unseen_after(body, pose, camera_to(240), seen)
    assert {x for x in found if x.rpartition('_')[0] in names or x in names} == found
    assert bool(found) == bool(names)


def test_legs_without_keypoints_leave_the_pelvis_free_to_turn(body, pose):
    without = ('hip', 'knee', 'ankle', 'toe')
    seen = Observation(keypoints=keypoints(body, pose, without))
    found = unseen_after(body, pose, camera_to(240), seen)
    assert found >= {'trunk_x', 'trunk_y', 'trunk_z', 'left_hip_x', 'right_ankle_y'}
    assert not any(x.startswith(('root', 'neck')) or 'elbow' in x for x in found)


def test_times_add_up_until_the_limb_is_shown_again(body, pose):
    limbs, camera = UnseenLimbs(body), camera_to(240)
    whole = Observation(keypoints=keypoints(body, pose))
    cut = Observation(keypoints=keypoints(body, pose, ('ankle', 'toe')))
    knee = body.dof_names.index('left_knee')
    limbs.update(body, camera, whole, pose, np.inf)
    for expected in (0.1, 0.2):
        limbs.update(body, camera, cut, pose, 0.1)
        assert limbs.of_dofs(body)[knee] == pytest.approx(expected)
    limbs.update(body, camera, whole, pose, 0.1)
    assert limbs.of_dofs(body).max() == 0.0


def test_unseen_joints_err_by_the_lengths_of_their_bones(body, pose):
    limbs = UnseenLimbs(body)
    assert limbs.with_larger_errors(body) is body
    seen = Observation(keypoints=keypoints(body, pose, ('knee', 'ankle', 'toe')))
    limbs.update(body, camera_to(240), seen, pose, np.inf)
    with_larger_errors = limbs.with_larger_errors(body)
    more = np.sqrt(with_larger_errors.joint_errors**2 - body.joint_errors**2)
    of = dict(zip(body.joint_names, more, strict=True))
    thigh, shin = (body.segment_lengths[x] for x in ('thigh', 'shin'))
    assert of['left_knee'] == pytest.approx(0.08 * thigh)
    assert of['right_ankle'] == pytest.approx(0.08 * np.hypot(thigh, shin))
    assert of['left_hip'] == of['left_wrist'] == of['head'] == 0.0


def sure_of(made, *kinds):
    """Keypoints that are confident only if their names contain one of these parts."""
    sure = [any(x in name for x in kinds) for name in made.names]
    return replace(made, confidences=np.where(sure, 0.9, 0.3))


TRUNK_AND_ARMS = ('hip', 'shoulder', 'elbow', 'wrist', 'head')


def test_a_leg_is_hidden_where_a_detector_is_sure_of_nothing_beyond_its_hip(body, pose):
    limbs, said = UnseenLimbs(body), keypoints(body, pose)
    assert limbs.without_guesses(body, said, 0) is said
    assert limbs.hidden is None
    found = limbs.without_guesses(body, sure_of(said, *TRUNK_AND_ARMS, 'left_ankle'), 1)
    lost = {x for x, c in zip(found.names, found.confidences, strict=True) if c == 0.0}
    assert lost == {'right_knee', 'right_ankle', 'right_toe'}
    _, shank, foot = body.skeleton.chains['right_leg']
    assert limbs.hidden.nonzero()[0].tolist() == [shank, foot]
    # A limb without any keypoint may be unknown to the detector.
    arms = said[np.flatnonzero([any(y in x for y in TRUNK_AND_ARMS) for x in said.names])]
    assert limbs.without_guesses(body, arms, 2) is arms


def test_an_arm_that_a_detector_guesses_is_not_hidden(body, pose):
    limbs, said = UnseenLimbs(body), sure_of(keypoints(body, pose), 'hip', 'knee', 'shoulder')
    assert limbs.without_guesses(body, said, 0) is said


def test_legs_stay_hidden_between_answers_of_a_slow_detector(body, pose):
    limbs, said = UnseenLimbs(body), sure_of(keypoints(body, pose), *TRUNK_AND_ARMS)
    limbs.without_guesses(body, said, 10**9)
    assert limbs.without_guesses(body, None, 15 * 10**8) is None
    assert limbs.hidden.sum() == 4
    limbs.without_guesses(body, None, 21 * 10**8)
    assert limbs.hidden is None
