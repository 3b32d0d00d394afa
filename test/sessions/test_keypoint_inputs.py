"""2D and 3D keypoints as inputs of the filter, and the meaning of their names."""

import numpy as np
import pytest

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.image_inputs import KEYPOINTS, KEYPOINTS_3D
from hmt_ros.sessions.keypoint_inputs import ChosenPerson
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from msg_tools.messages.detections import DetectedPerson
from test.sessions.conftest import JOINTS


@pytest.fixture
def session(stub_tracker, subject_file, outputs, small_camera):
    """A session with a known camera."""

    def make(**values):
        values = {'subject_file': str(subject_file), 'use_keypoints': True, **values}
        one = TrackingSession(with_values(FilterParameters(), values), outputs.append)
        one.take(CAMERA_INFO, small_camera.info())
        return one

    return make


def seen(stub_tracker):
    """Keypoints used for each image."""
    return [keypoints for _, keypoints in stub_tracker.made[0].seen]


@pytest.mark.parametrize(
    ('scheme', 'names', 'unknown', 'used'),
    [
        ('auto', ('nose', 'left_ear'), [], ('head', 'head')),
        # Valid: a landmark of a scheme without a nearby joint.
        ('auto', ('nose', 'spine'), [], ('head',)),
        ('auto', ('tail', 'left_foot_index'), ['tail'], ('left_toe',)),
        ('joints', ('neck', 'mid_hip'), ['mid_hip'], ('neck',)),
        ('body25', ('neck', 'mid_hip', 'left_pinky'), ['left_pinky'], ('neck', 'pelvis')),
    ],
)
def test_what_names_mean(session, small_camera, stub_tracker, scheme, names, unknown, used):
    one = session(keypoint_scheme=scheme)
    handled = one.take(KEYPOINTS, small_camera.keypoints(0, names=names))
    assert [text.partition(' are not')[0] for text in handled.warnings] == (
        [f'keypoints {unknown}'] if unknown else []
    )
    one.take(IMAGE, small_camera.image(0))
    assert [each.names for each in seen(stub_tracker)] == [used]


@pytest.mark.parametrize('order', [(0, 1, 2), (2, 1, 0), (1, 2, 0), (2, 0, 1)])
def test_positions_in_space_join_the_keypoints_by_name(session, small_camera, stub_tracker, order):
    inputs = [
        (IMAGE, small_camera.image(0)),
        (KEYPOINTS, small_camera.keypoints(0, names=('head', 'mid_hip', 'left_elbow'))),
        (KEYPOINTS_3D, small_camera.keypoints_3d(0, names=('nose', 'mid_hip', 'head'))),
    ]
    one = session(use_keypoints_3d=True)
    for index in order:
        assert one.take(*inputs[index]).warnings == ()
    (keypoints,) = seen(stub_tracker)
    assert keypoints.names == ('head', 'pelvis', 'left_elbow')
    np.testing.assert_array_equal(keypoints.positions, [[2, 0, 0], [1, 0, 0], [np.nan] * 3])


def test_positions_that_can_not_be_used_are_told(session, small_camera, stub_tracker):
    one = session(use_keypoints_3d=True)
    bad = small_camera.keypoints_3d(0, x=np.array([np.nan, 1, 2, 3, 4]))
    (fault,) = one.take(KEYPOINTS_3D, bad).faults
    assert 'keypoint left_hip lies at (nan, 0.0, 0.0)' in fault
    one.take(KEYPOINTS, small_camera.keypoints(0))
    one.take(IMAGE, small_camera.image(0))
    one.take(KEYPOINTS, small_camera.keypoints(1))
    one.take(KEYPOINTS_3D, small_camera.keypoints_3d(1, names=('tail',)))
    one.take(IMAGE, small_camera.image(1))
    assert one.state.faults['keypoints_3d'] == 2
    wanted = "has none of the names of its keypoints, such as 'left_hip', but 'tail'"
    assert wanted in one.state.last_fault
    assert [keypoints.names for keypoints in seen(stub_tracker)] == [JOINTS, JOINTS]


def test_parameters_of_keypoints():
    with pytest.raises(ValueError, match='use_keypoints_3d needs use_keypoints'):
        FilterParameters(use_keypoints_3d=True)
    with pytest.raises(ValueError, match=r"keypoint_scheme must be one of .* saw 'coco'"):
        FilterParameters(keypoint_scheme='coco')


# Choice of the person among several people.

NAMES = ('left_hip', 'right_hip', 'head')
SECOND = 10**9


def person(column, size=100.0, missing=()):
    """Keypoints of a person with the head in a column."""
    pixels = size * np.array([[-0.1, 1.0], [0.1, 1.0], [0.0, 0.0]]) + (column, 50.0)
    pixels[list(missing)] = np.nan
    covariances = np.tile(np.eye(2), (3, 1, 1))
    return DetectedPerson('', Keypoints(NAMES, pixels, covariances, np.ones(3)))


@pytest.fixture
def choose():
    chosen = ChosenPerson()

    def which(seconds, *people):
        found = chosen.choose(people, int(seconds * SECOND), 1.0)
        return next((i for i, x in enumerate(people) if x.keypoints is found), None)

    which.forget = chosen.forget
    return which


def test_first_the_largest_then_the_nearest(choose):
    assert choose(0.0, person(100, 80), person(400, 120)) == 1
    # The other person approaches the camera, and the order changes.
    assert choose(0.1, person(410, 100), person(110, 300)) == 0
    assert choose(0.2, person(130, 300), person(420, 100)) == 1


def test_somebody_else_is_not_taken_for_the_person(choose):
    assert choose(0.0, person(100)) == 0
    assert choose(0.1, person(400)) is None
    assert choose(0.2) is None
    assert choose(0.9, person(400), person(120)) == 1


def test_after_an_absence_the_largest_is_chosen_anew(choose):
    assert choose(0.0, person(100)) == 0
    assert choose(1.0, person(400)) is None
    assert choose(1.1, person(400)) == 0
    choose.forget()
    assert choose(1.2, person(100, 150), person(400)) == 0


def test_landmarks_that_are_missing(choose):
    assert choose(0.0, person(100)) == 0
    assert choose(0.1, person(300, missing=(1, 2)), person(105, missing=(1, 2))) == 1
    # The previously visible left hip is missing.
    assert choose(0.2, person(300, missing=(0, 2)), person(110, missing=(0, 2))) == 1
    assert choose(0.3, person(100, missing=(0, 1, 2))) is None
