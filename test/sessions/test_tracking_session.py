"""The tracking session, with a stub tracker."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.image_inputs import (
    COMPRESSED_MASK,
    DEPTH,
    KEYPOINTS,
    KEYPOINTS_3D,
    MASK,
    PREDICTION,
)
from hmt_ros.sessions.track_messages import TOPICS, TOPICS_OF_NODE
from hmt_ros.sessions.track_start import prepare_start
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.tracking import Status
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.keep_out import KeepOutState, keep_out_of
from msg_tools.messages.pose_mixtures import MixtureKind, TrackState, pose_mixture_of
from test.sessions.conftest import JOINTS, Likelihoods

MIXTURES = ['pose_mixture', 'likelihood_mixture']
STARTS = ['body', 'human_description']
ONE_IMAGE = [
    *MIXTURES,
    'person_pose',
    'ground',
    'human_joint_states',
    '/tf',
    'markers',
    'overlay/compressed',
    *(ROBOT := ['keep_out', 'keep_out_markers']),
]


@pytest.fixture
def session(stub_tracker, subject_file, outputs):
    def make(wanted=lambda topic: True, **values):
        values.setdefault('subject_file', str(subject_file))
        parameters = with_values(FilterParameters(), values)
        return TrackingSession(parameters, outputs.append, wanted)

    return make


def tracked(outputs):
    """Timestamps of the tracked images."""
    return [output.stamp_ns for output in outputs if output.topic == 'pose_mixture']


def test_images_become_messages_in_their_order(session, outputs, small_camera):
    one = session()
    assert one.take(CAMERA_INFO, small_camera.info()).published == ()
    first = one.take(IMAGE, small_camera.image(0))
    second = one.take(IMAGE, small_camera.image(1))
    assert [output.topic for output in outputs] == [*STARTS, *ONE_IMAGE, *ONE_IMAGE]
    assert first.published == tuple(
        (topic, small_camera.stamp(0)) for topic in [*STARTS, *ONE_IMAGE]
    )
    assert second.published == tuple((topic, small_camera.stamp(1)) for topic in ONE_IMAGE)
    assert (first.source, first.stamp_ns) == (IMAGE, small_camera.stamp(0))
    assert first.faults == first.warnings == ()
    assert one.state.counts == {'received': 2, 'tracked': 2}
    assert (one.state.status, one.state.modes, one.state.wants) == ('tracking', 2, '')
    assert np.isclose(one.state.entropy, -(0.75 * np.log(0.75) + 0.25 * np.log(0.25)))
    assert (one.state.misfit, one.state.evaluations) == (0.125, 7)
    told = dict(one.state.values())
    assert [float(told[f'belief in {cue}']) for cue in ('silhouette', 'track')] == [0.95, 0.95]


def mixtures_of(outputs, topic='pose_mixture'):
    """Contents of the mixtures on a topic."""
    data = [output.data for output in outputs if output.topic == topic]
    return [pose_mixture_of(deserialise(each, TOPICS[topic].msgtype)) for each in data]


def test_mixtures_tell_state_track_and_identities(session, outputs, small_camera, stub_tracker):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    one.take(IMAGE, small_camera.image(1))
    stub_tracker.empty.add(small_camera.stamp(2))
    one.take(IMAGE, small_camera.image(2))
    states = [TrackState.TRACKING, TrackState.TRACKING, TrackState.NOBODY]
    for topic in MIXTURES:
        found = mixtures_of(outputs, topic)
        assert [content.state for content in found] == states
        assert [content.track_id for content in found] == [1, 1, 1]
    ids = [content.identities.tolist() for content in mixtures_of(outputs)]
    assert ids == [[1, 77], [2, 77], []]
    # Reliabilities of the cues, as long as there is a track.
    shown = stub_tracker.made[-1].validity.shown
    told = [dict(content.cue_probabilities) for content in mixtures_of(outputs)]
    assert told == [shown, shown, {}]
    likelihoods = mixtures_of(outputs, 'likelihood_mixture')
    assert [content.cue_probabilities for content in likelihoods] == [{}, {}, {}]
    likelihoods = mixtures_of(outputs, 'likelihood_mixture')
    assert [content.identities.tolist() for content in likelihoods] == [[77, 1], [77, 1], []]


def test_a_lost_track_is_told(session, outputs, small_camera, stub_tracker, monkeypatch):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())

    def step(tracker, *inputs, **more):
        found = usual(tracker, *inputs, **more)
        tracker.estimate.status = Status.LOST
        return found

    usual = stub_tracker.step
    monkeypatch.setattr(stub_tracker, 'step', step)
    one.take(IMAGE, small_camera.image(0))
    assert [content.state for content in mixtures_of(outputs)] == [TrackState.LOST]
    assert [content.existence_probability for content in mixtures_of(outputs)] == [0.875]
    assert [len(content.cue_probabilities) for content in mixtures_of(outputs)] == [6]


def test_same_messages_same_bytes(session, outputs, small_camera):
    for _ in range(2):
        one = session()
        one.take(CAMERA_INFO, small_camera.info())
        for index in range(3):
            one.take(IMAGE, small_camera.image(index))
    half = len(outputs) // 2
    assert outputs[:half] == outputs[half:]


def test_what_nobody_wants_is_not_made(session, outputs, small_camera):
    one = session(wanted=lambda topic: topic == 'markers')
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    assert [output.topic for output in outputs] == [*STARTS, 'markers']
    assert one.state.counts['tracked'] == 1


@pytest.mark.usefixtures('few_wait')
def test_oldest_images_that_wait_are_dropped(session, outputs, small_camera):
    one = session(queue_size=2)
    handled = [one.take(IMAGE, small_camera.image(index)) for index in range(5)]
    assert [len(h.faults) for h in handled] == [0, 0, 1, 1, 1]
    assert [len(h.warnings) for h in handled] == [0, 0, 1, 0, 0]
    assert 'waited for a calibrated camera_info' in handled[2].warnings[0]
    one.take(CAMERA_INFO, small_camera.info())
    assert tracked(outputs) == [small_camera.stamp(3), small_camera.stamp(4)]
    assert one.state.counts == {'received': 5, 'tracked': 2, 'dropped': 3}
    assert one.state.faults['camera_info'] == 3


@pytest.mark.usefixtures('few_wait')
def test_uncalibrated_camera_is_told_once(session, outputs, small_camera):
    one = session(queue_size=1)
    handled = []
    for index in range(3):
        handled.append(one.take(CAMERA_INFO, small_camera.uncalibrated(index)))
        handled.append(one.take(IMAGE, small_camera.image(index)))
    warnings = [text for h in handled for text in h.warnings]
    assert warnings == [
        'camera_info has k[0] = 0: uncalibrated; calibrate the camera, and let its driver publish '
        'the result'
    ]
    # Three invalid calibrations, and two images that waited in vain.
    assert one.state.faults == {'camera_info': 5}
    assert one.state.wants == f'a calibrated camera_info; {warnings[0]}'
    one.take(CAMERA_INFO, small_camera.info(3))
    one.take(CAMERA_INFO, small_camera.uncalibrated(3))
    one.take(IMAGE, small_camera.image(3))
    assert tracked(outputs) == [small_camera.stamp(2), small_camera.stamp(3)]


def test_time_that_stands_still_or_jumps_back_is_skipped(session, outputs, small_camera):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    handled = [one.take(IMAGE, small_camera.image(index)) for index in (2, 2, 2, 1, 0, 3)]
    assert [len(h.faults) for h in handled] == [0, 1, 1, 1, 1, 0]
    assert [len(h.warnings) for h in handled] == [0, 1, 0, 1, 0, 0]
    assert 'wanted stamps that increase' in handled[1].warnings[0]
    assert 'reset_on_time_jump' in handled[3].warnings[0]
    assert tracked(outputs) == [small_camera.stamp(2), small_camera.stamp(3)]
    assert one.state.faults['time stands still'] == 2


def test_time_that_jumps_back_starts_the_track_anew(session, outputs, small_camera, stub_tracker):
    one = session(reset_on_time_jump=True)
    one.take(CAMERA_INFO, small_camera.info())
    for _ in range(2):
        for index in range(3):
            handled = one.take(IMAGE, small_camera.image(index))
            assert handled.faults == ()
    assert len(stub_tracker.made) == 2
    # A bag played twice gives the same results twice.
    half = len(outputs) // 2
    assert outputs[:half] == outputs[half:]
    assert [output.topic for output in outputs].count('body') == 2
    assert one.state.faults == {'time jumps back': 1}
    assert 'the track starts again' in one.state.last_fault


def test_images_that_wait_are_tracked_before_time_jumps(session, outputs, small_camera):
    one = session(reset_on_time_jump=True, use_keypoints=True)
    one.take(IMAGE, small_camera.image(5))
    one.take(IMAGE, small_camera.image(3))
    one.take(IMAGE, small_camera.image(4))
    assert one.state.counts == {'received': 3, 'dropped': 1}
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(1))
    one.take(IMAGE, small_camera.image(2))
    assert tracked(outputs) == [small_camera.stamp(3), small_camera.stamp(4)]
    for index in (1, 2):
        one.take(KEYPOINTS, small_camera.keypoints(index))
    assert tracked(outputs) == [small_camera.stamp(index) for index in (3, 4, 1, 2)]


def test_new_calibration_starts_the_track_anew(session, outputs, small_camera, stub_tracker):
    one = session()
    one.take(CAMERA_INFO, small_camera.info(0))
    one.take(IMAGE, small_camera.image(0))
    assert one.take(CAMERA_INFO, small_camera.info(1)).warnings == ()
    other = replace(small_camera.camera, fx=70.0)
    handled = one.take(CAMERA_INFO, small_camera.info(1, other))
    assert handled.warnings == ('camera_info changes: the track starts again',)
    one.take(IMAGE, small_camera.image(1))
    assert [tracker.camera for tracker in stub_tracker.made] == [small_camera.camera, other]
    assert len(tracked(outputs)) == 2


@pytest.mark.parametrize(
    ('spoil', 'message'),
    [
        (lambda m: setattr(m, 'encoding', 'yuv9'), "encoding 'yuv9' is not known, wanted one of"),
        (lambda m: setattr(m, 'width', 0), 'image has size 0x48, wanted at least one pixel'),
        (lambda m: setattr(m, 'data', m.data[:-1]), 'image has 9215 bytes, wanted 9216'),
        (lambda m: setattr(m, 'step', 10), 'image step is 10'),
    ],
)
def test_bad_images_are_skipped(session, outputs, small_camera, spoil, message):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    handled = []
    for index in range(3):
        image = small_camera.image(index)
        if index < 2:
            spoil(image)
        handled.append(one.take(IMAGE, image))
    assert [len(h.faults) for h in handled] == [1, 1, 0]
    assert [len(h.warnings) for h in handled] == [1, 0, 0]
    assert message in handled[0].warnings[0]
    assert tracked(outputs) == [small_camera.stamp(2)]
    assert one.state.counts == {'received': 3, 'tracked': 1, 'skipped': 2}


def test_damaged_pictures_are_skipped(session, outputs, small_camera):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    for data in (b'', b'\xff\xd8\xff\xe0', b'GIF89a'):
        image = small_camera.compressed(0)
        image.data = np.frombuffer(data, np.uint8)
        assert len(one.take(IMAGE, image).faults) == 1
    assert one.take(IMAGE, small_camera.compressed(0)).faults == ()
    assert tracked(outputs) == [small_camera.stamp(0)]


def test_messages_that_can_not_be_read_are_counted(session):
    one = session()
    first, second = (one.refuse(IMAGE, 'it breaks off') for _ in range(2))
    assert first.warnings == first.faults == ('message of image can not be read: it breaks off',)
    assert second.warnings == ()
    assert one.state.faults == {'message': 2}


# Nobody in view.


def read(output):
    return deserialise(output.data, TOPICS_OF_NODE[output.topic].msgtype)


def test_nobody_in_view_is_told_once(session, outputs, small_camera, stub_tracker):
    one = session(max_hypotheses=3)
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    stub_tracker.empty |= {small_camera.stamp(index) for index in (1, 2)}
    del outputs[:]
    handled = [one.take(IMAGE, small_camera.image(index)) for index in (1, 2)]
    shown = [*MIXTURES, 'markers', 'overlay/compressed', *ROBOT]
    assert handled[0].published == tuple((topic, small_camera.stamp(1)) for topic in shown)
    # Robots get a message for every image.
    assert handled[1].published == tuple((topic, small_camera.stamp(2)) for topic in ROBOT)
    assert handled[0].faults == handled[0].warnings == ()
    messages = {output.topic: read(output) for output in outputs}
    for topic, kind in zip(MIXTURES, (MixtureKind.POSTERIOR, MixtureKind.LIKELIHOOD), strict=True):
        content = pose_mixture_of(messages[topic])
        assert (len(content.weights), content.kind, content.frame_id) == (0, kind, 'lens')
        assert content.existence_probability == 0.875
    removed = {(marker.ns, marker.id): marker.action for marker in messages['markers'].markers}
    modes = {(f'mode_{rank}', key): 2 for rank in range(3) for key in (0, 1)}
    assert removed == {**modes, ('floor', 0): 2, ('contacts', 0): 2}
    state = one.state
    assert (state.status, state.trouble(), state.wants) == ('nobody', 'nobody in view', '')
    assert (state.modes, state.track_id, state.counts['tracked']) == (0, 1, 1)
    assert dict(state.values())['probability that a person is in view'] == '0.875'
    # The next person is another track of the same body.
    handled = one.take(IMAGE, small_camera.image(3))
    assert [topic for topic, _ in handled.published] == ONE_IMAGE
    assert (one.state.status, one.state.track_id) == ('tracking', 2)
    assert one.state.trouble() == ''


# Keypoints.


def seen(stub_tracker):
    """Names of the keypoints used with each image, None if missing."""
    return [
        None if keypoints is None else keypoints.names
        for tracker in stub_tracker.made
        for _, keypoints in tracker.seen
    ]


def test_inputs_are_not_used_unless_asked_for(session, small_camera, likelihoods, stub_tracker):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    for source, message in (
        (KEYPOINTS, small_camera.keypoints(0)),
        (KEYPOINTS_3D, small_camera.keypoints_3d(0)),
        (MASK, small_camera.mask(0, encoding='rgb8')),
        (MASK, small_camera.mask(0)),
        (DEPTH, small_camera.depth(0)),
        (PREDICTION, likelihoods.message(0)),
    ):
        assert one.take(source, message).faults == ()
    one.take(IMAGE, small_camera.image(0))
    (tracker,) = stub_tracker.made
    assert tracker.seen == [(small_camera.stamp(0), None)]
    assert tracker.masks == tracker.depths == tracker.predictions == [None]


def test_images_wait_for_keypoints(session, small_camera, stub_tracker, outputs):
    one = session(use_keypoints=True, input_timeout=0.25)
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    one.take(IMAGE, small_camera.image(1))
    assert tracked(outputs) == []
    # None for 0, because later ones have arrived. Nobody in 1 is an answer, too.
    one.take(KEYPOINTS, small_camera.keypoints(1, names=()))
    assert tracked(outputs) == [small_camera.stamp(0), small_camera.stamp(1)]
    # The detector is silent: an image waits until another one is more than 0.25 s newer.
    for index in (2, 3, 4):
        one.take(IMAGE, small_camera.image(index))
    assert len(tracked(outputs)) == 2
    one.take(IMAGE, small_camera.image(5))
    assert tracked(outputs)[2:] == [small_camera.stamp(2)]
    # Too late for 2 and all images that waited.
    one.take(KEYPOINTS, small_camera.keypoints(2))
    assert tracked(outputs)[3:] == []
    one.take(KEYPOINTS, small_camera.keypoints(5))
    assert tracked(outputs)[3:] == [small_camera.stamp(i) for i in (3, 4, 5)]
    # An answer without a person differs from no answer.
    assert seen(stub_tracker) == [None, (), None, None, None, JOINTS]


@pytest.mark.parametrize(
    ('fields', 'message'),
    [
        ({'u': [np.nan, 1.0], 'v': [1.0, 1.0]}, 'keypoint head lies at (nan, 1.0)'),
        ({'u': [np.inf, 1.0], 'v': [1.0, 1.0]}, 'keypoint head lies at (inf, 1.0)'),
        ({'u': [1.0], 'v': [1.0, 2.0]}, 'keypoints: u has 1 values, wanted 2'),
        ({'covariance': [-1.0, 0, 0, -1, 1, 0, 0, 1]}, 'not positive definite'),
        ({'confidence': [0.5, 1.5]}, 'confidence 1.5, wanted 0 to 1'),
    ],
)
def test_bad_keypoints_are_told_and_not_used(
    session, small_camera, stub_tracker, fields, message, outputs
):
    fields = {name: np.array(value) for name, value in fields.items()}
    one = session(use_keypoints=True)
    one.take(CAMERA_INFO, small_camera.info())
    warnings = []
    for index in range(2):
        keypoints = small_camera.keypoints(index, names=('head', 'left_hip'), **fields)
        warnings += one.take(KEYPOINTS, keypoints).warnings
        one.take(IMAGE, small_camera.image(index))
    assert len(warnings) == 1
    assert message in warnings[0]
    assert seen(stub_tracker) == [None, None]
    assert one.state.faults == {'keypoints': 2}


def kept(session, source):
    """Number of messages of an input that wait for their images."""
    return len(session._inputs[source]._content)


# Masks.


def masks(stub_tracker):
    """Number of the person's pixels in the mask of each image, None without a mask."""
    return [
        None if mask is None else int(mask.sum())
        for tracker in stub_tracker.made
        for mask in tracker.masks
    ]


@pytest.mark.parametrize('order', [(0, 1, 2, 3), (1, 0, 3, 2), (0, 2, 1, 3), (1, 3, 0, 2)])
def test_masks_go_with_the_image_of_their_stamp(
    session, small_camera, stub_tracker, order, outputs
):
    """In any order, compressed or not; a mask without a person is an answer, too."""
    inputs = [
        (IMAGE, small_camera.image(0)),
        (COMPRESSED_MASK, small_camera.compressed_mask(0)),
        (IMAGE, small_camera.image(1)),
        (MASK, small_camera.nobody(1)),
    ]
    one = session(use_mask=True)
    one.take(CAMERA_INFO, small_camera.info())
    for index in order:
        assert one.take(*inputs[index]).warnings == ()
    assert masks(stub_tracker) == [240, 0]
    assert stub_tracker.made[0].masks[0].dtype == bool
    assert stub_tracker.made[0].masks[0][12:36, 20:30].all()
    assert tracked(outputs) == [small_camera.stamp(0), small_camera.stamp(1)]


def test_images_wait_for_masks(session, small_camera, stub_tracker, outputs):
    one = session(use_mask=True, input_timeout=0.25)
    one.take(CAMERA_INFO, small_camera.info())
    for index in (0, 1, 2):
        one.take(IMAGE, small_camera.image(index))
    assert tracked(outputs) == []
    # An image that is more than 0.25 s newer ends the wait.
    handled = one.take(IMAGE, small_camera.image(3))
    assert tracked(outputs) == [small_camera.stamp(0)]
    assert handled.warnings == (f'no mask came for the image of {small_camera.stamp(0)} ns',)
    assert handled.faults == ()
    # So does the mask of a later image.
    one.take(MASK, small_camera.mask(2))
    assert tracked(outputs)[1:] == [small_camera.stamp(1), small_camera.stamp(2)]
    # Too late for 1.
    one.take(MASK, small_camera.mask(1))
    (warning,) = one.take(MASK, small_camera.mask(3)).warnings
    assert f'mask of {small_camera.stamp(1)} ns: no image with this stamp waits' in warning
    assert masks(stub_tracker) == [None, None, 240, 240]
    assert one.state.faults == {'no mask': 2, 'mask without an image': 1}


@pytest.mark.usefixtures('few_wait')
def test_images_wait_for_masks_and_keypoints(session, small_camera, stub_tracker, outputs):
    one = session(use_mask=True, use_keypoints=True, queue_size=2, input_timeout=60.0)
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    one.take(MASK, small_camera.mask(0))
    assert tracked(outputs) == []
    one.take(KEYPOINTS, small_camera.keypoints(0))
    assert tracked(outputs) == [small_camera.stamp(0)]
    one.take(KEYPOINTS, small_camera.keypoints(3))
    faults = [one.take(IMAGE, small_camera.image(index)).faults for index in (1, 2, 3)]
    assert faults[:2] == [(), ()]
    assert 'no mask of its stamp has come, and 2 newer images wait' in faults[2][0]


def broken(message):
    message.data = message.data[:-1]
    return message


@pytest.mark.parametrize(
    ('source', 'change', 'message'),
    [
        (MASK, lambda c: c.mask(0, encoding='bgr8'), "mask has encoding 'bgr8', wanted mono8 or"),
        (MASK, lambda c: c.mask(0, size=(32, 48)), 'has 32x48 pixels, wanted the 64x48 of its'),
        (MASK, lambda c: c.mask(0, fill=255), 'is zero nowhere, wanted zero where the person is'),
        (MASK, lambda c: broken(c.mask(0)), 'image has 3071 bytes, wanted 3072'),
        (
            COMPRESSED_MASK,
            lambda c: c.compressed(0),
            "starts with b'\\xff\\xd8\\xff\\xe0', wanted png",
        ),
    ],
)
def test_bad_masks_are_told_and_not_used(
    session, small_camera, stub_tracker, source, change, message, outputs
):
    """The image waits no longer; the next mask is used."""
    one = session(use_mask=True)
    one.take(CAMERA_INFO, small_camera.info())
    handled = [one.take(IMAGE, small_camera.image(0)), one.take(source, change(small_camera))]
    (fault,) = [fault for each in handled for fault in each.faults]
    assert message in fault
    one.take(IMAGE, small_camera.image(1))
    assert one.take(MASK, small_camera.mask(1)).faults == ()
    assert masks(stub_tracker) == [None, 240]
    assert one.state.faults == {'mask': 1}
    assert tracked(outputs) == [small_camera.stamp(0), small_camera.stamp(1)]


def test_masks_without_images_are_forgotten(session, small_camera):
    one = session(use_mask=True)
    for index in range(200):
        one.take(MASK, small_camera.mask(index))
    assert kept(one, MASK) == 64


# The background.


def test_a_person_in_the_background_is_told(session, small_camera, stub_tracker):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    assert one.state.trouble() == ''
    step = stub_tracker.step

    def doubts(self, *arguments, **named):
        self.silhouettes.doubted, self.silhouettes.share = True, 0.123
        self.silhouettes.known = 'forgotten'
        return step(self, *arguments, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stub_tracker, 'step', doubts)
        (warning,) = one.take(IMAGE, small_camera.image(1)).warnings
        assert one.take(IMAGE, small_camera.image(2)).warnings == ()
    assert warning.startswith(
        'the background was learned with the person in it, as the image of '
        f'{small_camera.stamp(1)} ns shows'
    )
    assert 'give background_file' in warning
    assert one.state.faults == {'background': 1}
    assert one.state.trouble() == 'the background was learned with the person in it; forgotten'
    assert dict(one.state.values())['background'] == 'forgotten'


# Starts.


def test_predictions_start_a_track(session, small_camera, likelihoods, stub_tracker, outputs):
    one = session(subject_file='', use_predictions=True)
    one.take(CAMERA_INFO, small_camera.info())
    assert one.state.wants == 'a pose_prediction with components'
    one.take(IMAGE, small_camera.image(0))
    one.take(PREDICTION, likelihoods.nobody(0))
    assert tracked(outputs) == []
    one.take(PREDICTION, likelihoods.message(1, kind=MixtureKind.PREDICTION))
    one.take(IMAGE, small_camera.image(1))
    one.take(IMAGE, small_camera.image(2))
    one.take(PREDICTION, likelihoods.nobody(2))
    assert tracked(outputs) == [small_camera.stamp(1), small_camera.stamp(2)]
    first, second = stub_tracker.made[0].predictions
    assert np.array_equal(first.mixture.means, likelihoods.mixture(1).means)
    assert np.allclose(
        list(first.body.segment_lengths.values()), list(likelihoods.body.segment_lengths.values())
    )
    assert second is None
    assert stub_tracker.made[0].nobody_predicted == [False, True]


def test_late_filter_leaves_images_out_but_not_what_was_predicted(
    session, small_camera, likelihoods, stub_tracker, outputs
):
    one = session(use_predictions=True)
    one.take(CAMERA_INFO, small_camera.info())
    left = likelihoods.nobody(3)
    left.state = int(TrackState.TRACKING)
    # All have arrived during an estimate.
    handled = [one.take(IMAGE, small_camera.image(index), more=True) for index in range(4)]
    for index in range(3):
        handled += [one.take(PREDICTION, likelihoods.message(index), more=True)]
    assert all(h.published == () and h.faults == () for h in handled)
    last = one.take(PREDICTION, left)
    assert tracked(outputs) == [small_camera.stamp(3)]
    assert len(last.faults) == 3
    assert f'image of {small_camera.stamp(2)} ns is dropped: newer ones came' in last.faults[2]
    assert one.state.counts == {'received': 4, 'tracked': 1, 'dropped': 3}
    assert one.state.faults == {'old start': 1}
    (used,) = stub_tracker.made[0].predictions
    assert np.array_equal(used.mixture.means, likelihoods.mixture(2).means)
    # Once.
    one.take(IMAGE, small_camera.image(4))
    one.take(PREDICTION, likelihoods.nobody(4))
    assert stub_tracker.made[0].nobody_predicted == [False, True]


def test_a_prediction_behind_the_pose_is_a_hypothesis_for_the_next_image(
    session, small_camera, likelihoods, stub_tracker
):
    """Experts that skip an image predict it after its pose is published."""
    one = session(use_predictions=True)
    one.take(CAMERA_INFO, small_camera.info())
    for index, behind in enumerate([likelihoods.message(0), likelihoods.nobody(1), None]):
        left = likelihoods.nobody(index)
        left.state = int(TrackState.TRACKING)
        one.take(PREDICTION, left)
        assert one.take(IMAGE, small_camera.image(index)).published
        if behind is not None:
            assert one.take(PREDICTION, behind).published == ()
    _, used, none = stub_tracker.made[0].predictions
    assert np.array_equal(used.mixture.means, likelihoods.mixture(0).means)
    assert none is None
    assert stub_tracker.made[0].nobody_predicted == [False, False, True]


def test_images_that_are_complete_at_once_are_all_used_in_lock_step(
    session, small_camera, likelihoods, outputs
):
    one = session(use_predictions=True)
    one.take(CAMERA_INFO, small_camera.info())
    for index in range(4):
        one.take(IMAGE, small_camera.image(index))
    one.take(PREDICTION, likelihoods.message(3))
    assert tracked(outputs) == [small_camera.stamp(index) for index in range(4)]


def test_bad_predictions_are_told_and_not_used(session, small_camera, likelihoods, outputs):
    one = session(subject_file='', use_predictions=True)
    one.take(CAMERA_INFO, small_camera.info())
    of_another = Likelihoods(load_body('human32')).message(0)
    crooked = likelihoods.message(1)
    crooked.components[0].mean = np.full(likelihoods.body.dimension, np.nan)
    strange = likelihoods.message(2)
    strange.segment_names[3] = 'tail'
    for index, message, text in (
        (0, of_another, 'human32'),
        (1, crooked, 'finite'),
        (2, strange, 'tail'),
    ):
        (fault,) = one.take(PREDICTION, message).faults
        assert text in fault
        one.take(IMAGE, small_camera.image(index))
    assert tracked(outputs) == []
    one.take(PREDICTION, likelihoods.message(4))
    one.take(IMAGE, small_camera.image(4))
    assert tracked(outputs) == [small_camera.stamp(4)]


def test_nothing_starts_without_a_subject(session, small_camera, outputs):
    one = session(subject_file='')
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    assert tracked(outputs) == []
    assert one.state.wants.startswith('subject_file, use_keypoints, use_mask, use_predictions, or')


def test_restarts_from_a_box(session, small_camera, stub_tracker, outputs):
    one = session()
    region = RosbagsMessages().create(
        'sensor_msgs/msg/RegionOfInterest', x_offset=4, y_offset=2, width=10, height=20,
        do_rectify=False,
    )  # fmt: skip
    one.restart(prepare_start(one.parameters, region=region))
    one.take(CAMERA_INFO, small_camera.info())
    assert one.state.wants == 'an image'
    one.take(IMAGE, small_camera.image(0))
    assert stub_tracker.made[0].box == (4, 2, 14, 22)
    region.height = 0
    with pytest.raises(ValueError, match='box has the width 10 and the height 0'):
        prepare_start(one.parameters, region=region)


def test_settings_reach_the_tracker(session, small_camera, stub_tracker, background_file):
    one = session(
        max_hypotheses=3,
        random_seed=5,
        background_file=str(background_file),
        evaluation_budget=200,
    )
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    (tracker,) = stub_tracker.made
    assert tracker.settings.max_hypotheses == 3
    assert tracker.settings.evaluation_budget == 200
    assert tracker.seed == 5
    assert tracker.silhouettes.background.frames > 0


def test_changed_parameters_take_effect_with_the_next_track(session, small_camera, stub_tracker):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    one.parameters = with_values(one.parameters, {'max_hypotheses': 3})
    one.take(IMAGE, small_camera.image(1))
    one.restart()
    one.take(IMAGE, small_camera.image(2))
    assert [t.settings.max_hypotheses for t in stub_tracker.made] == [8, 3]


def test_failed_start_is_told_and_not_tried_again(session, small_camera, stub_tracker, outputs):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    stub_tracker.fault = ValueError('no pose of the body\nexplains the keypoints')
    (text,) = one.take(IMAGE, small_camera.image(0)).warnings
    assert text.endswith('no pose of the body explains the keypoints')
    stub_tracker.fault = None
    one.take(IMAGE, small_camera.image(1))
    assert tracked(outputs) == []
    assert one.state.wants.startswith('subject_file, use_keypoints, use_mask, use_predictions, or')
    one.restart()
    one.take(IMAGE, small_camera.image(2))
    assert tracked(outputs) == [small_camera.stamp(2)]


def test_failed_estimate_skips_the_image(session, small_camera, stub_tracker, outputs):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    for index in (1, 2):
        stub_tracker.fault = np.linalg.LinAlgError('Singular matrix')
        assert (
            'can not be tracked: Singular matrix'
            in one.take(IMAGE, small_camera.image(index)).faults[0]
        )
    stub_tracker.fault = None
    one.take(IMAGE, small_camera.image(3))
    assert tracked(outputs) == [small_camera.stamp(0), small_camera.stamp(3)]
    assert one.state.faults == {'estimate': 2}


def test_files_that_vanish_do_not_end_it(session, small_camera, subject_file, outputs):
    one = session(reset_on_time_jump=True)
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(2))
    subject_file.unlink()
    one.take(IMAGE, small_camera.image(0))
    handled = one.take(IMAGE, small_camera.image(1))
    assert 'can not be read' in handled.faults[0]
    assert tracked(outputs) == [small_camera.stamp(index) for index in (2, 0, 1)]


def test_topics_are_those_of_the_architecture():
    assert set(TOPICS_OF_NODE) == {*STARTS, *ONE_IMAGE, 'pose_forecast'}
    assert TOPICS_OF_NODE.keys() - TOPICS.keys() == {'keep_out_markers'}
    assert [topic for topic, published in TOPICS.items() if published.latched] == STARTS


# Messages for robots.


def kept_out(outputs):
    return [keep_out_of(read(one)) for one in outputs if one.topic == 'keep_out']


def test_robots_are_told_of_every_image(session, outputs, small_camera, stub_tracker):
    one = session(keep_out_probability=0.9)
    one.take(CAMERA_INFO, small_camera.info())
    stub_tracker.empty |= {small_camera.stamp(2)}
    for index in (-1, 0, 1, 2):
        one.take(IMAGE, small_camera.image(index))
    found = kept_out(outputs)
    states = [KeepOutState.UNKNOWN, *2 * [KeepOutState.TRACKING], KeepOutState.NOBODY]
    assert [content.state for content in found] == states
    assert [content.stamp_ns for content in found] == [small_camera.stamp(i) for i in range(-1, 3)]
    assert [len(content.radii) > 0 for content in found] == [False, True, True, False]
    assert {content.probability for content in found} == {0.9}
    assert found[1].existence_probability == 0.875
    assert one.answered == 4


def test_a_camera_that_stops_makes_the_space_grow(session, outputs, small_camera):
    one = session()
    (before,) = [keep_out_of(read(x)) for x in one.stale(1.0, 0) if x.topic == 'keep_out']
    assert (before.state, len(before.radii)) == (KeepOutState.STALE, 0)
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    (last,) = kept_out(outputs)
    markers, capsules = sorted(one.stale(0.2, 1), key=lambda x: x.topic == 'keep_out')
    assert markers.topic == 'keep_out_markers'
    after = keep_out_of(read(capsules))
    assert (after.state, after.unseen) == (KeepOutState.STALE, 0.2)
    assert (after.radii - last.radii).tolist() == pytest.approx([1.3] * len(last.radii))
    # The watcher reports it without an image.
    assert len(kept_out(outputs)) == 1


def test_a_watchdog_says_nothing_where_a_newer_image_was_answered(session, small_camera):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    before = one.answered
    one.take(IMAGE, small_camera.image(0))
    assert one.stale(5.0, before) == []
    assert one.stale(5.0, one.answered) != []


def test_an_image_that_shows_nothing_frees_nothing(session, outputs, small_camera, stub_tracker):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    (tracker,) = stub_tracker.made
    # The posterior is a prediction, as long as the track has not ended.
    tracker.estimate.foreseen = True
    one.take(IMAGE, small_camera.image(1))
    # Tracking fails.
    stub_tracker.fault = ValueError('a hypothesis is not finite')
    one.take(IMAGE, small_camera.image(2))
    stub_tracker.fault, tracker.estimate.foreseen = None, False
    # An earlier image showed nobody, and now the lens is covered.
    stub_tracker.empty |= {small_camera.stamp(3), small_camera.stamp(4)}
    one.take(IMAGE, small_camera.image(3))
    tracker.estimate.nobody_shown = False
    one.take(IMAGE, small_camera.image(4))
    found = kept_out(outputs)
    assert [content.state.name for content in found] == [
        'TRACKING', 'LOST', 'LOST', 'NOBODY', 'UNKNOWN',
    ]  # fmt: skip
    assert [content.unseen for content in found[:3]] == pytest.approx([0.0, 0.1, 0.2])
    assert found[2].radii.min() > found[1].radii.min() > found[0].radii.min()


def test_a_track_of_nobody_leaves_nothing_behind(session, outputs, small_camera, stub_tracker):
    """After a false start there is neither a keep-out space nor the state NOBODY."""
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(0))
    (tracker,) = stub_tracker.made

    def step(*_, **__):
        tracker.estimate.status, tracker.estimate.reason = (
            Status.WAITING,
            'the scene was not seen empty',
        )
        tracker.estimate.existence_probability = np.nan
        return None, None

    tracker.step = step
    one.take(IMAGE, small_camera.image(1))
    found = kept_out(outputs)
    assert [content.state.name for content in found] == ['TRACKING', 'UNKNOWN']
    assert len(found[1].radii) == 0
    # The configured start is still awaited.
    assert found[1].reason.startswith('waiting for an image of')
    last = [
        pose_mixture_of(deserialise(x.data, TOPICS['pose_mixture'].msgtype))
        for x in outputs if x.topic == 'pose_mixture'
    ][-1]  # fmt: skip
    assert (last.state, last.reason) == (TrackState.UNKNOWN, 'the scene was not seen empty')


def test_a_reset_does_not_free_the_space(session, outputs, small_camera):
    one = session()
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(1))
    one.restart(replace(one.start, initial=None, box=None))
    one.take(IMAGE, small_camera.image(2))
    found = kept_out(outputs)
    assert [content.state for content in found] == [KeepOutState.TRACKING, KeepOutState.LOST]
    assert found[1].unseen == pytest.approx(0.1)


def test_where_time_begins_again_nothing_is_known(session, outputs, small_camera):
    one = session(reset_on_time_jump=True)
    one.take(CAMERA_INFO, small_camera.info())
    one.take(IMAGE, small_camera.image(1))
    for index in (-5, -4):
        one.take(IMAGE, small_camera.image(index))
    found = kept_out(outputs)
    unknown = [KeepOutState.UNKNOWN] * 2
    assert [content.state for content in found] == [KeepOutState.TRACKING, *unknown]
    assert len(found[1].radii) == 0


def test_forecasts_lie_on_a_grid_of_time(session, outputs, small_camera):
    one = session(forecast_rate=20.0, forecast_horizon=0.1)
    one.take(CAMERA_INFO, small_camera.info())
    for index in (0, 1):
        one.take(IMAGE, small_camera.image(index))
    found = [pose_mixture_of(read(x)) for x in outputs if x.topic == 'pose_forecast']
    assert [x.stamp_ns for x in found] == [small_camera.stamp(i) for i in (0.5, 1, 1.5, 2)]
    assert {x.kind for x in found} == {MixtureKind.FORECAST}
    assert found[0].means[0, 0] - found[1].means[0, 0] == pytest.approx(-0.05)
