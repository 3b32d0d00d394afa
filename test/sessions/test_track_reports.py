"""Events of a track are reported once: start, loss, recovery, end, a moved camera."""

import re

import numpy as np
import pytest

from hmt_ros.sessions import camera_session
from hmt_ros.sessions.camera_session import (
    CAMERA_INFO,
    CAMERA_MOVED_FAULT,
    IMAGE,
    MAX_INCOMPLETE_IMAGES,
)
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.tracking import Status


@pytest.fixture
def one(stub_tracker, subject_file, outputs, small_camera):
    found = TrackingSession(FilterParameters(subject_file=str(subject_file)), outputs.append)
    found.take(CAMERA_INFO, small_camera.info())
    return found


@pytest.fixture
def lost(stub_tracker, monkeypatch):
    """Timestamps of images at which the track is lost."""
    stamps, step = set(), stub_tracker.step

    def patched(self, image, stamp, *arguments, **named):
        known, self.status = self.status, Status.TRACKING if stamp in stamps else self.status
        found = step(self, image, stamp, *arguments, **named)
        if stamp in stamps:
            self.status, self.reason = Status.LOST, 'no mode explains 62% of what is seen'
        elif known is Status.LOST:
            self.track_id = 1
        return found

    monkeypatch.setattr(stub_tracker, 'step', patched)
    return stamps


def test_loss_and_recovery_are_told_once(one, small_camera, lost):
    lost |= {small_camera.stamp(index) for index in (2, 3, 4, 7)}
    handled = [one.take(IMAGE, small_camera.image(index)) for index in range(9)]
    assert all(each.faults == () for each in handled)
    told = {index: each.events for index, each in enumerate(handled) if each.events}
    warned = {index: each.warnings for index, each in enumerate(handled) if each.warnings}
    assert sorted(told) == [0, 5, 8]
    assert told[0][0].startswith('track 1 starts from ')
    assert told[5] == (f'track 1 is found again at the image of {small_camera.stamp(5)} ns',)
    # The first image of every loss.
    assert sorted(warned) == [2, 7]
    assert warned[2] == (
        f'track 1 is lost at the image of {small_camera.stamp(2)} ns: no mode explains 62% of '
        'what is seen; it is searched for',
    )
    assert one.state.faults == {'loss of the track': 2}


def test_nobody_in_view_and_the_next_track_are_told_once(one, small_camera, stub_tracker):
    stub_tracker.empty |= {small_camera.stamp(index) for index in (1, 2, 3)}
    handled = [one.take(IMAGE, small_camera.image(index)) for index in range(6)]
    told = {index: each.events for index, each in enumerate(handled) if each.events}
    assert sorted(told) == [0, 1, 4]
    assert re.match(r'nobody in view at the image of \d+ ns: track 1 ends', told[1][0])
    assert told[4][0].startswith('track 2 starts')
    assert [each.warnings for each in handled] == 6 * [()]


def test_a_moved_camera_is_told_once(one, small_camera, stub_tracker):
    one.take(IMAGE, small_camera.image(0))
    watch = stub_tracker.made[0].silhouettes.watch
    assert one.state.trouble() == ''
    handled, step = [], stub_tracker.step
    for index in range(1, 7):
        shift = {3: 12.0, 4: 13.0, 6: np.nan}.get(index, 0.0)

        def seen(self, *arguments, shift=shift, **named):
            watch.moved, watch.shift = shift != 0, shift
            return step(self, *arguments, **named)

        stub_tracker.step = seen
        handled.append(one.take(IMAGE, small_camera.image(index)).warnings)
    stub_tracker.step = step
    assert [len(texts) for texts in handled] == [0, 0, 1, 0, 0, 1]
    assert handled[2][0].startswith(
        f'{CAMERA_MOVED_FAULT}: at the image of {small_camera.stamp(3)} ns the scene is 12 px '
        'away; fix the camera, take background_file again'
    )
    assert 'the scene is elsewhere' in handled[5][0]
    assert one.state.trouble() == CAMERA_MOVED_FAULT


@pytest.mark.parametrize(
    ('flag', 'text'),
    [
        (
            'gravity_contradicted',
            'the lines of the scene, or the person, contradict the given gravity',
        ),
        ('gravity_reversed', 'the opposite is used, [0.00, 1.00, 0.00]'),
    ],
)
def test_doubts_about_gravity_are_told_once(
    one, small_camera, stub_tracker, monkeypatch, flag, text
):
    step, told = stub_tracker.step, []
    for index, doubted in enumerate((False, False, True, True)):

        def seen(self, *arguments, doubted=doubted, **named):
            setattr(self, flag, doubted)
            return step(self, *arguments, **named)

        monkeypatch.setattr(stub_tracker, 'step', seen)
        told.append(one.take(IMAGE, small_camera.image(index)).warnings)
    assert [len(texts) for texts in told] == [0, 0, 1, 0]
    assert text in told[2][0]


def test_what_a_dropped_image_waited_for_is_known(stub_tracker, subject_file, small_camera):
    parameters = FilterParameters(
        subject_file=str(subject_file), use_keypoints=True, input_timeout=60.0
    )
    one = TrackingSession(parameters, lambda output: None)
    for index in range(MAX_INCOMPLETE_IMAGES + 1):
        one.take(IMAGE, small_camera.image(index))
    assert one.state.held_up == 'a calibrated camera_info'
    one.take(CAMERA_INFO, small_camera.info())
    first = MAX_INCOMPLETE_IMAGES + 1
    for index in range(first, first + 2):
        one.take(IMAGE, small_camera.image(index))
    assert one.state.held_up == 'keypoints'
    # Only slow processing explains images that never arrived here.
    one.count_dropped(3)
    assert one.state.held_up == ''
    assert one.state.counts['dropped'] == 1 + 2 + 3


def test_images_that_wait_have_a_limit_of_bytes(
    monkeypatch, stub_tracker, subject_file, small_camera
):
    one = TrackingSession(FilterParameters(subject_file=str(subject_file)), lambda output: None)
    monkeypatch.setattr(camera_session, 'MAX_INCOMPLETE_BYTES', 0)
    for index in range(3):
        one.take(IMAGE, small_camera.image(index))
    assert one.state.counts['dropped'] == 2  # the newest still waits


def test_what_is_needed_follows_the_parameters(stub_tracker, subject_file, small_camera):
    one = TrackingSession(
        FilterParameters(
            subject_file=str(subject_file), use_keypoints=True, use_mask=True, gravity_frame='map'
        ),
        lambda output: None,
    )
    needed = [(each.sources, each.with_each) for each in one.needed_inputs()]
    assert needed == [
        (('image',), False),
        (('camera_info',), False),
        (('mask', 'mask/compressed'), True),
        (('keypoints',), True),
        (('tf', 'tf_static'), False),
    ]
    one.take(CAMERA_INFO, small_camera.uncalibrated())
    # It arrives, and the reason for its rejection has been reported.
    assert ('camera_info',) not in [each.sources for each in one.needed_inputs()]
