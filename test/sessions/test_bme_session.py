"""The BME session, with a stub predictor."""

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.body import Camera, load_body
from hmt_ros.image.empty_scene import UNSEEN
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.bme_session import SILHOUETTE, TOPICS, TRACK, BmeSession
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.handled import Handled
from hmt_ros.sessions.image_inputs import MASK
from msg_tools import RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.images import compressed_image_message, decode_mask, image_message
from msg_tools.messages.keypoints import keypoints_message
from msg_tools.messages.pose_mixtures import MixtureKind, TrackState, pose_mixture_of

FRAME_NS = 100_000_000
# Sufficient number of images of a static scene.
STILL = 16


@pytest.fixture
def session(stub_predictor, background_file, outputs):
    def make(wanted=TOPICS.__contains__, **values):
        values = {'background_file': str(background_file), **values}
        return BmeSession(with_values(BmeParameters(), values), outputs.append, wanted)

    return make


def predictions(outputs):
    return [deserialise(output.data, 'hmt_msgs/msg/PoseMixture') for output in outputs]


def test_every_image_has_a_prediction(session, outputs, somebody, stub_predictor):
    one = session()
    one.take(CAMERA_INFO, somebody.info())
    handled = one.take(IMAGE, somebody.image(0))
    assert handled == Handled(
        IMAGE, somebody.stamp(0), (), (), (('pose_prediction', somebody.stamp(0)),)
    )
    (message,) = predictions(outputs)
    content = pose_mixture_of(message)
    assert content.kind == MixtureKind.PREDICTION
    assert (content.stamp_ns, content.frame_id) == (somebody.stamp(0), 'lens')
    assert content.body_model == 'human37'
    assert np.allclose(content.mixture.weights, [0.7, 0.3])
    body = stub_predictor.body
    assert np.allclose(content.joint_positions, body.joint_positions(content.mixture.means))
    state = one.state
    assert (state.status, state.modes, state.wants) == ('predicting', 2, '')
    assert state.support == 0.5
    assert state.height == 24
    assert np.isclose(state.entropy, -(0.7 * np.log(0.7) + 0.3 * np.log(0.3)))
    assert state.counts == {'received': 1, 'predicted': 1}
    ((mask, *_),) = stub_predictor.asked
    assert mask.shape == (48, 64)
    assert mask.sum() == pytest.approx(24 * 10, rel=0.1)


def test_same_messages_same_bytes(session, outputs, somebody):
    for _ in range(2):
        one = session()
        one.take(CAMERA_INFO, somebody.info())
        for index in range(3):
            one.take(IMAGE, somebody.image(index))
    assert outputs[:3] == outputs[3:]


def test_nobody_is_a_prediction_without_components(session, outputs, somebody, stub_predictor):
    one = session()
    one.take(CAMERA_INFO, somebody.info())
    one.take(IMAGE, somebody.empty(0))
    (message,) = predictions(outputs)
    assert len(message.components) == 0
    assert (message.kind, message.body_model) == (MixtureKind.PREDICTION, 'human37')
    assert one.state.status == 'nobody'
    assert one.state.counts == {'received': 1, 'predicted': 1, 'empty': 1}
    assert stub_predictor.asked == []


def test_background_is_learned_from_an_empty_scene(session, outputs, somebody):
    """A person in view from the first image is not learned as background."""
    one = session(background_file='')
    one.take(CAMERA_INFO, somebody.info())
    for index in range(STILL):
        one.take(IMAGE, somebody.image(index))
        assert (one.state.status, one.state.wants) == ('learning', UNSEEN)
    for index in range(STILL, 2 * STILL):
        one.take(IMAGE, somebody.empty(index))
    assert one.state.status == 'nobody'
    one.take(IMAGE, somebody.image(2 * STILL))
    found = predictions(outputs)
    assert [len(message.components) for message in found] == [0] * (2 * STILL) + [2]
    reasons = [message.reason for message in found]
    assert set(reasons[:STILL]) == {UNSEEN}
    assert set(reasons[-2:]) == {''}


def test_masks_are_the_silhouettes(session, outputs, somebody, stub_predictor):
    """Without a background; distant parts belong to another person."""
    one = session(background_file='', use_mask=True)
    one.take(CAMERA_INFO, somebody.info())
    mask = somebody.mask(0)
    mask.data.reshape(48, 64)[20:26, 50:54] = 1
    one.take(MASK, mask)
    one.take(IMAGE, somebody.image(0))
    assert [(found.sum(), found[12:36, 20:30].all()) for found, *_ in stub_predictor.asked] == [
        (240, True)
    ]
    assert (one.state.status, one.state.height, one.state.wants) == ('predicting', 24, '')
    # The background is learned from images without a person.
    for index in range(1, 8):
        one.take(MASK, somebody.nobody(index))
        one.take(IMAGE, somebody.empty(index))
    assert one.state.status == 'nobody'
    one.take(IMAGE, somebody.image(8))
    one.take(MASK, somebody.mask(9))
    assert stub_predictor.asked[1][0].sum() == pytest.approx(240, rel=0.1)
    assert [len(message.components) for message in predictions(outputs)] == [2, *[0] * 7, 2]


def test_predictions_take_those_before_into_account(session, somebody, stub_predictor, monkeypatch):
    monkeypatch.setattr(stub_predictor, 'dynamics', 'a model')
    one = session(propagation='experts')
    one.take(CAMERA_INFO, somebody.info())
    for index in (0, 1, 7):
        one.take(IMAGE, somebody.image(index))
    (_, first, _), (_, second, _), (_, third, _) = stub_predictor.asked
    assert first is None
    assert len(second) == 2
    assert stub_predictor.intervals[1] == pytest.approx(0.1)
    assert third is None
    alone = session()
    alone.take(CAMERA_INFO, somebody.info())
    for index in (0, 1):
        alone.take(IMAGE, somebody.image(index))
    assert [previous for _, previous, _ in stub_predictor.asked[3:]] == [None, None]


def test_rule_one_needs_a_model_of_it(session, stub_predictor):
    with pytest.raises(ValueError, match='trained with --dynamics'):
        session(propagation='experts')
    with pytest.raises(ValueError, match=r"propagation must be one of .* saw 'rule'"):
        session(propagation='rule')


def test_known_stature_narrows_the_depth(session, somebody, stub_predictor):
    for values in ({}, {'stature': 1.9}):
        one = session(**values)
        one.take(CAMERA_INFO, somebody.info())
        one.take(IMAGE, somebody.image(0))
    (_, _, unknown), (_, _, known) = stub_predictor.asked
    assert known < unknown / 2


def test_failed_prediction_skips_the_image(session, outputs, somebody, stub_predictor):
    one = session()
    one.take(CAMERA_INFO, somebody.info())
    stub_predictor.fault = ValueError('the person is\nbehind the camera')
    (text,) = one.take(IMAGE, somebody.image(0)).warnings
    assert text.endswith('the person is behind the camera')
    stub_predictor.fault = None
    one.take(IMAGE, somebody.image(1))
    assert len(outputs) == 1


@pytest.mark.parametrize('made', [image_message, compressed_image_message])
def test_one_image_is_predicted_on_demand(session, somebody, stub_predictor, made):
    one = session()
    message = made(somebody.messages, somebody.picture(7), somebody.stamp(7), 'lens')
    with pytest.raises(ValueError, match='no calibrated camera_info has come yet'):
        one.predict_once(message)
    one.take(CAMERA_INFO, somebody.info())
    one.take(IMAGE, somebody.image(0))
    content = pose_mixture_of(one.predict_once(message))
    assert (content.kind, content.stamp_ns) == (MixtureKind.PREDICTION, somebody.stamp(7))
    # The image is not part of the sequence.
    assert stub_predictor.asked[-1][1] is None
    assert one.state.counts == {'received': 1, 'predicted': 1}
    with pytest.raises(ValueError, match='nobody is seen: the silhouette is 0 px high'):
        one.predict_once(somebody.empty(8))
    with pytest.raises(ValueError, match='image has 32x24 pixels, wanted the 64x48'):
        one.predict_once(somebody.image(8, size=(32, 24)))
    learning = session(background_file='')
    learning.take(CAMERA_INFO, somebody.info())
    with pytest.raises(ValueError, match='has not been seen empty'):
        learning.predict_once(message)


def test_model_file_that_can_not_be(background_file, tmp_path):
    for name, content in (('nowhere.npz', None), ('garbage.npz', b'PK not a model')):
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        parameters = with_values(BmeParameters(), {'model_file': str(path)})
        with pytest.raises(ValueError, match=name):
            BmeSession(parameters, lambda output: None)


def track(likelihoods, index, state=TrackState.TRACKING):
    message = (
        likelihoods.nobody(index) if state == TrackState.NOBODY else likelihoods.message(index)
    )
    message.state = int(state)
    return message


def looked_at(stub_predictor, one, somebody, indices):
    before = len(stub_predictor.asked)
    handled = [one.take(IMAGE, somebody.image(index)) for index in indices]
    assert all(len(h.published) == 1 and h.faults == () for h in handled)
    return len(stub_predictor.asked) - before


def test_tracked_person_is_predicted_at_a_low_rate(
    session, outputs, somebody, stub_predictor, likelihoods
):
    one = session(tracked_interval=0.3)
    one.take(CAMERA_INFO, somebody.info())
    # Without a track, from every image.
    assert looked_at(stub_predictor, one, somebody, range(3)) == 3
    for index in range(3, 9):
        one.take(TRACK, track(likelihoods, index - 1))
        looked_at(stub_predictor, one, somebody, [index])
    content = predictions(outputs)
    seen = [True, True, True, False, False, True, False, False, True]
    assert [len(message.components) > 0 for message in content] == seen
    assert [message.state for message in content[3:5]] == [TrackState.TRACKING] * 2
    assert (content[3].kind, content[3].header.frame_id) == (MixtureKind.PREDICTION, 'lens')
    assert one.state.counts == {'received': 9, 'predicted': 5, 'left': 4}
    assert dict(one.state.values())['images left to the track'] == '4'


@pytest.mark.parametrize('state', [TrackState.LOST, TrackState.NOBODY, TrackState.UNKNOWN])
def test_every_image_is_predicted_from_without_a_sure_track(
    session, somebody, stub_predictor, likelihoods, state
):
    one = session(tracked_interval=100.0)
    one.take(CAMERA_INFO, somebody.info())
    looked_at(stub_predictor, one, somebody, [0])
    one.take(TRACK, track(likelihoods, 0))
    assert looked_at(stub_predictor, one, somebody, [1]) == 0
    one.take(TRACK, track(likelihoods, 1, state))
    assert looked_at(stub_predictor, one, somebody, [2, 3]) == 2


def test_track_counts_no_more_after_time_has_jumped(session, somebody, stub_predictor, likelihoods):
    one = session(tracked_interval=100.0, reset_on_time_jump=True)
    one.take(CAMERA_INFO, somebody.info())
    looked_at(stub_predictor, one, somebody, [5])
    one.take(TRACK, track(likelihoods, 5))
    assert looked_at(stub_predictor, one, somebody, [6]) == 0
    assert one.take(IMAGE, somebody.image(1)).published == ()
    assert len(one.take(IMAGE, somebody.image(2)).published) == 2
    assert len(stub_predictor.asked) == 3
    # Unusable messages are reported as usual.
    one.take(TRACK, track(likelihoods, 2))
    one.parameters = replace(one.parameters, reset_on_time_jump=False)
    assert 'comes after one of' in one.take(IMAGE, somebody.image(1)).faults[0]


def test_every_image_has_a_silhouette_that_is_a_mask(
    session, outputs, somebody, stub_predictor, likelihoods
):
    one = session(lambda topic: topic == SILHOUETTE, tracked_interval=100.0)
    one.take(CAMERA_INFO, somebody.info())
    one.take(IMAGE, somebody.image(0))
    one.take(TRACK, track(likelihoods, 0))
    one.take(IMAGE, somebody.image(1))
    one.take(IMAGE, somebody.empty(2))
    assert len(stub_predictor.asked) == 1
    assert one.state.counts['left'] == 2
    assert [output.topic for output in outputs] == [SILHOUETTE] * 3
    messages = [deserialise(output.data, 'sensor_msgs/msg/Image') for output in outputs]
    assert [(m.encoding, m.header.frame_id) for m in messages] == [('mono8', 'lens')] * 3
    masks = [decode_mask(message) for message in messages]
    ((asked, *_),) = stub_predictor.asked
    assert np.array_equal(masks[0], asked)
    assert [int(mask.sum()) for mask in masks[1:]] == [masks[0].sum(), 0]
    # Another session that gets it as a mask has the same result.
    other = session(use_mask=True)
    other.take(CAMERA_INFO, somebody.info())
    other.take(IMAGE, somebody.image(0))
    other.take(MASK, messages[0])
    assert np.array_equal(stub_predictor.asked[1][0], asked)


# Keypoints.


@pytest.fixture
def walker():
    """A camera, and keypoints of a person in front of it."""
    body, camera = load_body('human37'), Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
    pose = body.prior_mean.copy()
    pose[:3] = 0.2, 0.0, 4.0
    pixels = camera.project(body.joint_positions(pose[None])[0])
    n = len(pixels)
    unknown = np.full((n, 2, 2), np.nan)
    return body, camera, pose, Keypoints(body.joint_names, pixels, unknown, np.ones(n))


def keypoint_session(outputs, **values):
    values = {'predict_from': 'keypoints', **values}
    return BmeSession(with_values(BmeParameters(), values), outputs.append)


def test_keypoints_have_predictions_without_images(outputs, walker):
    body, camera, pose, seen = walker
    messages, one = RosbagsMessages(), keypoint_session(outputs)
    assert [x.sources for x in one.needed_inputs()] == [('keypoints',), (CAMERA_INFO,)]
    early = one.take('keypoints', keypoints_message(messages, seen, 5, 'lens'))
    assert 'no calibrated camera_info' in early.faults[0]
    one.take(CAMERA_INFO, camera_info_message(messages, camera, 10, 'lens'))
    assert (one.state.status, one.state.wants) == ('nobody', '')
    for t in range(3):
        stamp = 10 + t * FRAME_NS
        handled = one.take('keypoints', keypoints_message(messages, seen, stamp, 'lens'))
        assert handled.published == (('pose_prediction', stamp),)
        assert not handled.faults
    content = pose_mixture_of(predictions(outputs)[-1])
    assert content.kind == MixtureKind.PREDICTION
    assert 1 <= len(content.weights) <= 5
    assert content.weights.sum() == pytest.approx(1.0)
    joints = body.joint_positions(content.means[:1])[0]
    off = np.linalg.norm(camera.project(joints) - seen.pixels, axis=1)
    assert np.median(off) < 15.0
    assert content.means[0, 2] == pytest.approx(pose[2], rel=0.15)
    assert one.state.status == 'predicting'
    assert one.state.counts['predicted'] == 3


@pytest.fixture
def both(session, somebody):
    """A session of both cues, and keypoints of the person in the images of `somebody`."""
    body, camera = load_body('human37'), Camera(80.0, 80.0, 31.5, 23.5, 64, 48)
    pose = body.prior_mean.copy()
    pose[:3] = 0.0, 0.0, 4.0
    pixels = camera.project(body.joint_positions(pose[None])[0])
    n = len(pixels)
    shown = Keypoints(body.joint_names, pixels, np.full((n, 2, 2), np.nan), np.ones(n))
    messages = RosbagsMessages()

    def keypoints(index, count=n):
        return keypoints_message(messages, shown[np.arange(count)], somebody.stamp(index), 'lens')

    def make(**values):
        one = session(predict_from='both', **values)
        one.take(CAMERA_INFO, somebody.info())
        return one

    return make, keypoints


def test_an_image_waits_for_its_keypoints_and_is_predicted_from_them(
    both, outputs, somebody, stub_predictor
):
    make, keypoints = both
    one = make()
    assert ('keypoints',) in [x.sources for x in one.needed_inputs()]
    assert one.take(IMAGE, somebody.image(0)).published == ()
    handled = one.take('keypoints', keypoints(0))
    assert handled.published == (('pose_prediction', somebody.stamp(0)),)
    assert stub_predictor.asked == []
    alone = BmeSession(with_values(BmeParameters(), {'predict_from': 'keypoints'}), outputs.append)
    alone.take(CAMERA_INFO, somebody.info())
    alone.take('keypoints', keypoints(0))
    assert outputs[0] == outputs[1]


def test_silhouettes_count_where_keypoints_show_nobody(both, outputs, somebody, stub_predictor):
    make, keypoints = both
    one = make()
    for index, count in enumerate((0, 3)):
        one.take(IMAGE, somebody.image(index))
        one.take('keypoints', keypoints(index, count))
    assert [len(x.components) for x in predictions(outputs)] == [2, 2]
    assert len(stub_predictor.asked) == 2
    # Keypoints of the previous image are not used for an image without any.
    one.take(IMAGE, somebody.image(2))
    one.take('keypoints', keypoints(2))
    one.take(IMAGE, somebody.image(3))
    one.take(IMAGE, somebody.image(12))
    assert len(predictions(outputs)) == 4
    assert len(stub_predictor.asked) == 3


def test_the_background_is_learned_where_keypoints_show_nobody(both, outputs, somebody):
    make, keypoints = both
    one = make(background_file='')
    one.take(IMAGE, somebody.image(0))
    one.take('keypoints', keypoints(0))
    assert one.state.status == 'predicting'
    for index in range(1, STILL + 1):
        one.take(IMAGE, somebody.empty(index))
        one.take('keypoints', keypoints(index, 0))
        wanted = ('learning', UNSEEN) if index < STILL else ('nobody', '')
        assert (one.state.status, one.state.wants) == wanted
    one.take(IMAGE, somebody.image(STILL + 1))
    one.take('keypoints', keypoints(STILL + 1, 0))
    assert [len(x.components) for x in predictions(outputs)][1:] == [0] * STILL + [2]


def test_keypoints_that_can_not_be_used_are_told_and_count_as_none(both, outputs, somebody):
    make, keypoints = both
    one = make()
    bad = keypoints(0)
    bad.u = bad.u[:3]
    one.take(IMAGE, somebody.image(0))
    assert 'keypoints' in one.take('keypoints', bad).faults[0]
    assert [len(x.components) for x in predictions(outputs)] == [2]
    strange = keypoints(1, 2)
    strange.names = ['antenna', 'wheel']
    one.take(IMAGE, somebody.image(1))
    assert 'antenna' in one.take('keypoints', strange).warnings[0]
    with pytest.raises(ValueError, match=r"predict_from must be one of .* saw 'all'"):
        BmeParameters(predict_from='all')
    with pytest.raises(ValueError, match="'both' needs a lifter"):
        BmeParameters(predict_from='both', lifter='')


def test_a_stray_track_counts_for_no_image(session, somebody, stub_predictor, likelihoods):
    one = session(tracked_interval=100.0)
    one.take(CAMERA_INFO, somebody.info())
    looked_at(stub_predictor, one, somebody, [0])
    one.take(TRACK, track(likelihoods, 36_000))
    assert looked_at(stub_predictor, one, somebody, [1]) == 1
    one.take(TRACK, track(likelihoods, 1))
    assert looked_at(stub_predictor, one, somebody, [2]) == 0
