"""Scores of feet against the floor, for feet whose scores are known."""

import json

import numpy as np
import pytest

from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.app.truth import read_truth
from hmt_ros.evaluation.ground_scores import FEET, TrueGround, ground_scores

SECOND = 1_000_000_000
NAMES = ('pelvis', *FEET)
STEP = SECOND // 10


def ground_of(view, standing=(True, False), moved=(0.0, 0.0, 0.0)):
    """The floor in the frame of a camera that stands elsewhere in the world."""
    return TrueGround(
        view.rotation[:, 2],
        view.height,
        None if standing is None else np.array(standing),
        view.rotation.T,
        view.to_world(np.zeros(3)) + moved,
    )


def in_the_camera(view, feet, moved=(0.0, 0.0, 0.0)):
    """Joints of the feet in the camera frame, from places (4, 3) in the world, m."""
    return view.to_camera(np.vstack([[0.0, 0.0, 1.0], feet]) - np.array(moved))


def places(shift=0.0, height=0.1):
    """Ankles and toes at a height; the left foot is shifted forward."""
    feet = np.zeros((4, 3))
    feet[:, 2] = height
    feet[[0, 2], 1] += shift
    feet[[1, 3], 1] += 5 * shift
    return feet


def test_a_foot_that_stands_still_before_a_moving_camera():
    joints, truth = {}, {}
    for k in range(5):
        view = Viewpoint(distance=4.0, height=1.0 + 0.1 * k, pitch=0.05 * k)
        moved = (0.3 * k, 0.0, 0.0)
        joints[k * STEP] = in_the_camera(view, places(), moved)
        truth[k * STEP] = ground_of(view, (True, True), moved)
    found = ground_scores(joints, NAMES, truth)
    assert found.sliding == pytest.approx(0.0, abs=1e-9)
    assert (found.depth, found.sunk, found.frames) == (0.0, 0.0, 5)


def test_speed_and_depth():
    view = Viewpoint(pitch=0.2)
    joints = {k * STEP: in_the_camera(view, places(0.02 * k, -0.03)) for k in range(4)}
    truth = {k * STEP: ground_of(view) for k in range(4)}
    found = ground_scores(joints, NAMES, truth)
    # The right foot, which is faster, does not stand.
    assert found.sliding == pytest.approx(0.2)
    assert found.depth == pytest.approx(0.03)
    assert found.sunk == 1.0
    assert found.summary() == {
        'sliding_m_per_s': pytest.approx(0.2),
        'below_floor_mm': pytest.approx(30.0),
        'fraction_below_floor': 1.0,
        'frames': 4,
    }
    assert json.loads(json.dumps(found.summary()))['frames'] == 4
    assert 'standing ankles slide 0.200 m/s; ankles and toes lie 30.0 mm below' in str(found)


def test_frames_that_are_no_neighbours_do_not_count():
    view = Viewpoint()
    stamps = [0, STEP, 2 * STEP, 10 * STEP]
    joints = {t: in_the_camera(view, places(1.0 * (t > 2 * STEP))) for t in stamps}
    assert ground_scores(joints, NAMES, dict.fromkeys(stamps, ground_of(view))).sliding == 0.0


def test_what_is_not_known():
    view = Viewpoint()
    joints = {0: in_the_camera(view, places()), STEP: in_the_camera(view, places())}
    unknown = dict.fromkeys(joints, ground_of(view, None))
    assert ground_scores(joints, NAMES, unknown).sliding is None
    assert str(ground_scores(joints, NAMES, unknown)).startswith('ankles and toes lie 0.0 mm')
    one = {0: ground_of(view)}
    assert ground_scores(joints, NAMES, one).sliding is None
    assert ground_scores(joints, NAMES, {}) is None
    assert ground_scores(joints, ('pelvis', 'a', 'b', 'c', 'd'), unknown) is None


def truth_file(path, **changes):
    content = {
        'stamps': np.array([0, STEP]),
        'joint_names': np.array(NAMES),
        'joints': np.zeros((2, 5, 3)),
        'gravity': np.tile([0.0, 9.81, 0.0], (2, 1)),
        'camera_height': np.array([1.2, 1.3]),
        'contact': np.array([[1, 0], [0, 0]]),
    }
    content = {k: v for k, v in {**content, **changes}.items() if v is not None}
    np.savez(path, **content)
    return path


def test_truth_of_a_file(tmp_path):
    ground = read_truth(truth_file(tmp_path / 'a.npz')).ground
    np.testing.assert_allclose(ground[0].up, [0.0, -1.0, 0.0])
    assert ground[STEP].height == 1.3
    assert ground[0].standing.tolist() == [True, False]
    np.testing.assert_array_equal(ground[0].camera_rotation, np.eye(3))
    turned = np.tile([0.0, 0.0, 1.0, 0.0], (2, 1))
    pose = {'camera_quaternion': turned, 'camera_position': np.ones((2, 3)), 'contact': None}
    ground = read_truth(truth_file(tmp_path / 'b.npz', **pose)).ground
    np.testing.assert_allclose(ground[0].camera_rotation, np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
    assert ground[0].standing is None
    for name in ('gravity', 'camera_height'):
        assert read_truth(truth_file(tmp_path / 'c.npz', **{name: None})).ground == {}


@pytest.mark.parametrize(
    ('changes', 'why'),
    [
        ({'gravity': np.zeros((2, 3))}, 'gravity or camera_height is zero or not finite'),
        ({'camera_height': np.array([1.0, np.nan])}, 'is zero or not finite somewhere'),
        ({'gravity': np.zeros(3)}, r'gravity has shape \(3,\), wanted \(2, 3\)'),
        ({'contact': np.zeros((2, 3))}, r'contact has shape \(2, 3\), wanted \(2, 2\)'),
    ],
)
def test_bad_truth(tmp_path, changes, why):
    with pytest.raises(ValueError, match=why):
        read_truth(truth_file(tmp_path / 'truth.npz', **changes))
