"""Gravity from parameters and transforms, as passed to the tracker."""

import numpy as np
import pytest

from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.track_messages import TOPICS
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.sessions.transform_buffer import TF, TF_STATIC
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.ground import ground_of
from msg_tools.messages.states import transforms_message


@pytest.fixture
def session(stub_tracker, subject_file, outputs):
    def make(**values):
        values = {'subject_file': str(subject_file), 'gravity_frame': 'world', **values}
        return TrackingSession(with_values(FilterParameters(), values), outputs.append)

    return make


def view(index, *, height=1.2, pitch=0.1):
    """A camera above a floor, with its pitch increased by `pitch` at each image."""
    return Viewpoint(distance=4.0, height=height, pitch=pitch * index)


def transforms(stamp, *, seen=None, frames=('world', 'lens'), **options):
    """Transforms with the camera's pose in the world."""
    seen = view(0) if seen is None else seen
    place = seen.to_world(np.zeros(3))
    return transforms_message(
        RosbagsMessages(), [frames[0]], [frames[1]], seen.rotation.T[None], place[None], stamp
    )


def at(small_camera, index, **options):
    return transforms(small_camera.stamp(index), seen=view(index, **options))


def up_of(index, pitch=0.1):
    return [0.0, -np.cos(pitch * index), -np.sin(pitch * index)]


def grounds(outputs):
    return [
        ground_of(deserialise(output.data, TOPICS['ground'].msgtype))
        for output in outputs
        if output.topic == 'ground'
    ]


@pytest.mark.parametrize('first', [TF, IMAGE])
def test_gravity_at_every_image(session, stub_tracker, small_camera, outputs, first):
    one = session(floor_in_gravity_frame=True, camera_height=3.0)
    one.take(CAMERA_INFO, small_camera.info())
    for index in range(3):
        pair = [(TF, at(small_camera, index)), (IMAGE, small_camera.image(index))]
        for source, message in pair if first == TF else reversed(pair):
            handled = one.take(source, message)
        assert 'pose_mixture' in [topic for topic, _ in handled.published]
        assert handled.warnings == ()
    (tracker,) = stub_tracker.made
    np.testing.assert_allclose(tracker.known_ground.up, up_of(0), atol=1e-12)
    assert np.isclose(tracker.known_ground.camera_height, 1.2)
    np.testing.assert_allclose(tracker.gravities, [up_of(1), up_of(2)], atol=1e-12)
    found = [g.up for g in grounds(outputs)]
    np.testing.assert_allclose(found, [up_of(k) for k in range(3)], atol=1e-12)
    assert one.state.faults == {}


def test_missing_transforms_do_not_stop_the_track(session, stub_tracker, small_camera, outputs):
    one = session(gravity=[0.0, 1.0, 0.0], input_timeout=0.15)
    one.take(CAMERA_INFO, small_camera.info())
    one.take(TF_STATIC, transforms(0, frames=('map', 'base')))
    warnings = []
    for index in range(8):
        warnings += one.take(IMAGE, small_camera.image(index)).warnings
    # Each waits for a transform that is 0.15 s newer.
    assert len(grounds(outputs)) == 6
    assert warnings == [
        f"no transform from gravity_frame 'world' to 'lens' at the image of "
        f"{small_camera.stamp(0)} ns: there is no frame 'world'; there are: base, map; the track "
        'continues with the last known gravity'
    ]
    assert one.state.faults == {'no transform': 6}
    (tracker,) = stub_tracker.made
    np.testing.assert_allclose(tracker.known_ground.up, [0.0, -1.0, 0.0])
    # Waiting images are tracked as soon as possible.
    one.take(TF, at(small_camera, 6))
    assert len(grounds(outputs)) == 7
    np.testing.assert_allclose(tracker.gravities[-1], up_of(6), atol=1e-12)
    # A transform of a later time shows that none of this time will arrive.
    one.take(TF, transforms(small_camera.stamp(9), frames=('map', 'base')))
    assert len(grounds(outputs)) == 8
    np.testing.assert_allclose(tracker.gravities[-1], up_of(6), atol=1e-12)


def test_a_camera_below_the_floor_has_no_height(session, stub_tracker, small_camera):
    one = session(floor_in_gravity_frame=True, camera_height=1.1)
    one.take(CAMERA_INFO, small_camera.info())
    message = at(small_camera, 0)
    message.transforms[0].transform.translation.z = -0.25
    one.take(TF, message)
    handled = one.take(IMAGE, small_camera.image(0))
    assert handled.faults == ()
    assert handled.warnings == (
        "the camera lies 0.25 m below z = 0 of gravity_frame 'world', which can not be the floor",
    )
    assert stub_tracker.made[0].known_ground.camera_height == 1.1


def test_bad_transforms_are_counted(session, small_camera, outputs):
    one = session(input_timeout=0.0)
    one.take(CAMERA_INFO, small_camera.info())
    for index in range(2):
        bad = at(small_camera, index)
        bad.transforms[0].transform.translation.x = np.nan
        handled = one.take(TF, bad)
        assert handled.faults == ()
        assert len(handled.warnings) == (index == 0)
        assert 'its numbers are not finite' in one.state.last_fault
        one.take(IMAGE, small_camera.image(index))
    one.take(IMAGE, small_camera.image(2))
    assert len(grounds(outputs)) == 2
    assert one.state.faults == {'transform': 2, 'no transform': 2}


def test_time_that_jumps_back_gives_the_same_again(session, stub_tracker, small_camera, outputs):
    one = session(reset_on_time_jump=True)
    one.take(CAMERA_INFO, small_camera.info())
    for _ in range(2):
        for index in range(4):
            one.take(IMAGE, small_camera.image(index))
            one.take(TF, at(small_camera, index))
    assert len(stub_tracker.made) == 2
    half = len(outputs) // 2
    assert outputs[:half] == outputs[half:]


# The pose of the camera.


@pytest.mark.parametrize('first', [TF, IMAGE])
def test_the_pose_of_the_camera_at_every_image(session, stub_tracker, small_camera, first):
    one = session(gravity_frame='', fixed_frame='world')
    one.take(CAMERA_INFO, small_camera.info())
    for index in range(3):
        pair = [(TF, at(small_camera, index)), (IMAGE, small_camera.image(index))]
        for source, message in pair if first == TF else reversed(pair):
            handled = one.take(source, message)
        assert handled.warnings == ()
    (tracker,) = stub_tracker.made
    assert tracker.known_ground.up is None
    assert tracker.gravities == []
    for index, (position, rotation) in enumerate(tracker.poses):
        seen = view(index)
        np.testing.assert_allclose(position, seen.to_world(np.zeros(3)), atol=1e-12)
        np.testing.assert_allclose(rotation, seen.rotation.T, atol=1e-12)
    assert len(tracker.poses) == 3
    assert one.state.faults == {}


def test_a_missing_pose_is_told_once_and_loses_no_image(session, stub_tracker, small_camera):
    one = session(gravity_frame='', fixed_frame='world', input_timeout=0.0)
    one.take(CAMERA_INFO, small_camera.info())
    warnings = []
    for index in range(5):
        if index < 2:
            one.take(TF, at(small_camera, index))
        warnings += one.take(IMAGE, small_camera.image(index)).warnings
    one.take(IMAGE, small_camera.image(5))
    (tracker,) = stub_tracker.made
    assert len(tracker.seen) == 5
    assert len(tracker.poses) == 2
    last, wanted = small_camera.stamp(1), small_camera.stamp(2)
    assert warnings == [
        f"no transform from 'lens' to fixed_frame 'world' at the image of {wanted} ns: 'lens' has "
        f'transforms of {small_camera.stamp(0)} to {last} ns, wanted {wanted} ns; the motion '
        'of the camera is assumed to continue for 0.5 s'
    ]
    assert one.state.faults == {'no pose of the camera': 3}


def test_stale_gravity_is_not_given_again(session, stub_tracker, small_camera):
    """Without further transforms the tracker propagates gravity by itself."""
    one = session(fixed_frame='world', input_timeout=0.0)
    one.take(CAMERA_INFO, small_camera.info())
    for index in range(4):
        if index < 2:
            one.take(TF, at(small_camera, index))
        one.take(IMAGE, small_camera.image(index))
    (tracker,) = stub_tracker.made
    assert len(tracker.seen) == 3
    np.testing.assert_allclose(tracker.gravities, [up_of(1)], atol=1e-12)
    assert len(tracker.poses) == 2
