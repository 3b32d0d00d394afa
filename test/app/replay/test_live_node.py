"""replay --live: the real nodes write the same bag as the offline run, byte for byte."""

import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from hmt_ros.app.replay import live_node, one_bag
from hmt_ros.app.replay.command import main
from hmt_ros.app.replay.options import NodeParameters
from hmt_ros.app.replay.player import (
    LiveNodeError,
)
from hmt_ros.app.replay.tracks import LiveTrack
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.declared_parameters import with_values
from hmt_ros.sessions.image_inputs import KEYPOINTS
from hmt_ros.sessions.tracking_parameters import FilterParameters
from msg_tools import BagReader, BagWriter, RosbagsMessages
from msg_tools.messages.headers import header_message, time_ns
from msg_tools.messages.images import decode_image, image_message
from test.app.replay.test_transforms import FRAME, with_transforms

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[3]
REACH = ROOT / 'bags' / 'reach'
PERSON = ['--subject', str(REACH / 'subject.yaml'), '--background', str(REACH / 'background.png')]
MESSAGES = RosbagsMessages()


def recorded(images):
    """(topic, log time, message) of the first images of a bag, with all related messages."""
    found = []
    with BagReader(REACH) as bag:
        first = next(bag.messages(['image/compressed'])).log_time_ns
        for stored in bag.messages(['image/compressed', 'camera_info', 'ground_truth']):
            if stored.log_time_ns - first >= images * 10**9 // 15:
                break
            found.append((stored.topic[1:], stored.log_time_ns, stored.message))
    return found


def write(folder, entries):
    with BagWriter(folder) as bag:
        for topic, time, message in entries:
            bag.write(topic, time, message)
    return folder


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def messages(folder, topic):
    with BagReader(folder) as bag:
        return [(stored.log_time_ns, bytes(stored.data)) for stored in bag.messages([topic])]


@pytest.fixture
def in_one_process(monkeypatch):
    """Makes the nodes of live replays share a process, which starts faster than three."""
    monkeypatch.setattr(one_bag, 'LiveTrack', partial(LiveTrack, together=True))


def both_ways(bag, tmp_path, capsys, *options, person=PERSON):
    """Folders, exit codes and lines of the same replay, offline and live."""
    folders, ends = [], []
    for how in ('offline', 'live'):
        out = tmp_path / how / 'out'
        command = [str(bag), '-o', str(out), *person, *options]
        code = main([*command, '--live'] if how == 'live' else command)
        streams = capsys.readouterr()
        folders.append(out)
        ends.append((code, streams.out.replace(how, ''), streams.err))
    return folders, ends


def test_same_of_every_image_without_a_subject(tmp_path, capsys):
    """Each node in a process of its own.

    Predictions of the BME reach the filter with their image. The BME node also gets the track, so
    the second image is 0.07 s after the first.
    """
    bag = write(tmp_path / 'bag', recorded(3))
    # Filter and smoother publish links on the same topic.
    options = ['--set', 'smoother.publish_tf=true', '--set', 'forecast_rate=50.0']
    options += ['--set', 'bme.tracked_interval=0.1']
    (offline, live), (one, other) = both_ways(bag, tmp_path, capsys, *options, person=PERSON[2:])
    assert one == other
    assert one[0] == 0
    assert len(messages(offline, '/tf')) == 6
    mixtures = ('pose_mixture', 'likelihood_mixture', 'smoothed_pose_mixture', 'trajectory_mixture')
    for topic in mixtures:
        # Windows are smoothed ten times a second.
        assert len(messages(offline, topic)) == (2 if topic == 'trajectory_mixture' else 3)
        assert messages(offline, topic) == messages(live, topic)
    with BagReader(offline) as bag_out:
        found = [len(x.message.components) > 0 for x in bag_out.messages(['pose_prediction'])]
    assert found == [True, False, True]
    # Messages for robots, too.
    assert len(messages(offline, 'keep_out')) == 3
    assert len(messages(offline, 'pose_forecast')) > 3
    # And everything else.
    assert content(offline) == content(live)


@pytest.mark.usefixtures('in_one_process')
def test_same_predictions_from_keypoints_and_silhouettes(tmp_path, capsys):
    """The subject is given, gravity is from transforms, and the nodes share a process."""
    entries = with_transforms(recorded(3))
    stamp = next(time for topic, time, _ in entries if topic == 'image/compressed')
    seen = MESSAGES.create(
        'hmt_msgs/msg/Keypoints2D',
        header=header_message(MESSAGES, stamp, ''),
        names=[f'{side}_{x}' for x in ('shoulder', 'hip', 'knee') for side in ('left', 'right')],
        u=150.0 + 10.0 * np.tile((0.0, 2.0), 3),
        v=100.0 + 10.0 * np.repeat((0.0, 4.0, 8.0), 2),
    )
    bag = write(
        tmp_path / 'bag', sorted([*entries, ('keypoints', stamp, seen)], key=lambda x: x[1])
    )
    options = ['--bme', '--set', 'bme.predict_from=both', '--set', 'use_keypoints=false']
    options += ['--set', 'forecast_rate=50.0', *FRAME, '--with-images']
    (offline, live), (one, other) = both_ways(bag, tmp_path, capsys, *options)
    assert one == other
    assert one[0] == 0
    for topic in ('pose_prediction', 'pose_mixture', 'smoothed_pose_mixture'):
        assert len(messages(live, topic)) == 3
    assert len(messages(live, 'pose_forecast')) > 3
    assert messages(live, '/tf_static') == messages(bag, '/tf_static') != []
    assert content(offline) == content(live)


@pytest.mark.usefixtures('in_one_process')
def test_same_of_a_person_who_leaves_and_returns(tmp_path, capsys):
    """There is one mixture without components, then a new track."""
    entries, period = recorded(3), 10**9 // 15
    images = [(x[1], decode_image(x[2])) for x in entries if x[0] == 'image/compressed']
    empty = cv2.imread(str(REACH / 'background.png'))
    shown = [*(image for _, image in images), *[empty] * 8, *[images[0][1]] * 8]
    camera = next(x for x in entries if x[0] == 'camera_info')
    stamps = [images[0][0] + i * period for i in range(len(shown))]
    pictures = [
        ('image', stamp, image_message(MESSAGES, picture, stamp, ''))
        for stamp, picture in zip(stamps, shown, strict=True)
    ]
    bag = write(tmp_path / 'bag', [camera, *pictures])
    options = ['--set', 'max_hypotheses=2', '--set', 'evaluation_budget=100']
    options += ['--set', 'smoother.fixed_lag=0.1']
    (offline, live), (one, other) = both_ways(bag, tmp_path, capsys, *options)
    assert one == other
    assert one[0] == 0
    assert '12 of 19 images tracked' in one[1]
    for topic in ('pose_mixture', 'likelihood_mixture', 'smoothed_pose_mixture'):
        with BagReader(offline) as bag_out:
            found = [
                (stamps.index(stored.log_time_ns), len(stored.message.components))
                for stored in bag_out.messages([topic])
            ]
        # The person is visible in 0 to 2 and from 11 on; changes are confirmed over some images.
        assert [index for index, _ in found] == [*range(9), 15, 16, 17, 18]
        assert [index for index, count in found if count == 0] == [8]
    for topic in ('human_joint_states', '/tf'):
        assert len(messages(offline, topic)) == 12
    assert [stamps.index(stamp) for stamp, _ in messages(offline, 'markers')][8] == 8
    assert content(offline) == content(live)


@pytest.mark.usefixtures('in_one_process')
def test_same_of_raw_images_with_keypoints_masks_and_faults(tmp_path, capsys):
    """With late keypoints and masks, an image of another size, and a time jump."""
    entries = []
    for topic, time, message in recorded(3):
        if topic == 'image/compressed':
            stamp = time_ns(message.header.stamp)
            picture = decode_image(message)
            seen = MESSAGES.create(
                'hmt_msgs/msg/Keypoints2D',
                header=header_message(MESSAGES, stamp, ''),
                names=['left_wrist', 'tail', 'right_wrist'],
                u=np.array([272.0, 10.0, np.nan]),
                v=np.array([213.0, 10.0, np.nan]),
            )
            lifted = MESSAGES.create(
                'hmt_msgs/msg/Keypoints3D',
                header=header_message(MESSAGES, stamp, ''),
                names=['right_wrist', 'left_wrist'],
                **{axis: np.array([0.1, -0.1]) for axis in 'xyz'},
            )
            half = image_message(MESSAGES, picture[::2].copy(), stamp + 5000, '')
            entries.append(('image', time, image_message(MESSAGES, picture, stamp, '')))
            entries.append(('image', time + 5000, half))
            entries.append(('keypoints', time + 9000, seen))
            entries.append(('keypoints_3d', time + 9500, lifted))
            shown = picture.max(2) > 128
            mask = image_message(MESSAGES, shown.astype(np.uint8), stamp, '')
            mask.encoding = '8UC1' if len(entries) < 4 else 'rgb8'
            entries.append(('mask', time + 10_000, mask))
        elif topic == 'camera_info':
            entries.append((topic, time + 1000, message))
    again = [message for topic, _, message in entries if topic == 'image']
    for message in again[:3:2]:
        entries.append(('image', entries[-1][1] + 10_000, message))
    bag = write(tmp_path / 'bag', sorted(entries, key=lambda entry: entry[1]))
    options = ['--keep-going', '--set', 'reset_on_time_jump=true', '--set', 'frame_prefix=x']
    options += ['--set', 'smoother.reset_on_time_jump=true', '--set', 'smoother.fixed_lag=0.1']
    options += ['--set', 'max_hypotheses=2', '--set', 'evaluation_budget=100']
    (offline, live), (one, other) = both_ways(bag, tmp_path, capsys, *options)
    assert one == other
    assert one[0] == 0
    assert "keypoints ['tail'] are not used" in one[2]
    assert "mask has encoding 'rgb8', wanted mono8 or 8UC1" in one[2]
    assert 'has 480x180 pixels' in one[2]
    assert 'the track starts again' in one[2]
    assert len(messages(offline, 'pose_mixture')) == 5
    # The smoother goes back in time as the filter does.
    smoothed = [stamp for stamp, _ in messages(offline, 'smoothed_pose_mixture')]
    assert smoothed == [stamp for stamp, _ in messages(offline, 'likelihood_mixture')]
    assert content(offline) == content(live)


@pytest.fixture
def parameters():
    values = {'subject_file': str(REACH / 'subject.yaml'), 'image_transport': 'compressed'}
    return with_values(FilterParameters(), values)


class Nobody:
    """A publisher without subscribers."""

    def publish(self, data):
        pass


def test_node_that_is_silent_or_dies_is_told(parameters, monkeypatch):
    entries = {topic: message for topic, _, message in recorded(1)}
    with LiveTrack(NodeParameters(parameters), lambda *output: None) as track:
        running = track._filter
        handled = track.take(CAMERA_INFO, entries['camera_info'])
        assert (handled.source, handled.faults, handled.published) == (CAMERA_INFO, (), ())
        with monkeypatch.context() as patch:
            patch.setattr(live_node, 'MESSAGE_SECONDS', 1.0)
            patch.setitem(running._publishers, KEYPOINTS, Nobody())
            with pytest.raises(LiveNodeError, match='waited 1 s for an answer to a keypoints; '):
                track.take(KEYPOINTS, entries['camera_info'])
        running.process.kill()
        with pytest.raises(LiveNodeError, match='the filter node ended with code -9: '):
            track.take(IMAGE, entries['image/compressed'])
        # The process can not end normally any more.
        monkeypatch.setattr(running, 'stop', lambda: 0)


def test_without_ros_it_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'rclpy', None)
    out = tmp_path / 'out'
    assert main([str(REACH), '-o', str(out), *PERSON, '--live']) == 1
    *_, line = capsys.readouterr().err.splitlines()
    assert line.startswith('replay: --live needs a sourced ROS 2 workspace')
    assert list(tmp_path.iterdir()) == []
