"""Diagnostics of a node: rates, silence, errors, middleware events, a status line."""

import re
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def running(stub_tracker, subject_file, world_of):
    from sensor_msgs.msg import CameraInfo, Image

    from hmt_ros.nodes.filter_node import FilterNode

    inputs = {'image': Image, 'camera_info': CameraInfo}
    return world_of(FilterNode, 'filter_node', inputs, subject_file=str(subject_file)).start()


@pytest.fixture
def smoother(world_of):
    """A smoother without a publisher of mixtures."""
    from hmt_ros.nodes.smoother_node import SmootherNode

    return world_of(SmootherNode, 'smoother_node', {}).start()


def best_effort():
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    return QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)


def test_publisher_that_does_not_fit_is_one_warning_with_topic_and_policy(smoother):
    from hmt_msgs.msg import PoseMixture

    wrong = [
        smoother.other.create_publisher(PoseMixture, 'likelihood_mixture', best_effort())
        for _ in range(2)
    ]
    key = 'publishers of /likelihood_mixture with another reliability'
    smoother.spin_until(lambda: smoother.diagnosis()[2].get(key) == '2', 'both events')
    # The other node logs warnings, too, in later lines.
    assert [text.splitlines()[0] for text in smoother.warnings()] == [
        '/likelihood_mixture: a publisher offers another reliability than is asked for, none of '
        'its messages will arrive; see "ros2 topic info --verbose /likelihood_mixture" (more of '
        'this kind are counted in /diagnostics)'
    ]
    level, message, _ = smoother.diagnosis()
    assert level == 1
    assert message == '/likelihood_mixture: publishers offer another reliability than is asked for'
    # One compatible publisher is enough.
    good = smoother.other.create_publisher(PoseMixture, 'likelihood_mixture', 10)
    smoother.spin_until(
        lambda: smoother.diagnosis()[1] == 'waits for likelihood_mixture', 'the publisher'
    )
    for publisher in (good, *wrong):
        smoother.other.destroy_publisher(publisher)


def test_lost_messages_are_told_once_and_counted():
    from hmt_ros.nodes.diagnostics import MiddlewareEvents

    texts = []
    events = MiddlewareEvents(texts.append)
    callbacks = events.of_subscription('/a/image')
    for count in (2, 3):
        callbacks.message_lost(SimpleNamespace(total_count_change=count))
    events.of_subscription('/a/other').message_lost(SimpleNamespace(total_count_change=1))
    assert events.lost == 6
    assert [text.partition(' (more')[0] for text in texts] == [
        '/a/image: 2 messages were lost on their way',
        '/a/other: 1 messages were lost on their way',
    ]
    assert events.values() == [
        ('messages lost', '6'),
        ('messages lost of /a/image', '5'),
        ('messages lost of /a/other', '1'),
    ]


def test_silence_is_told(running, small_camera):
    running.send('camera_info', small_camera.info())
    running.send('image', small_camera.image(0))
    running.patience(3.0)
    running.node._silent.arrived('image', time.monotonic() - 20)
    running.spin_until(
        lambda: re.match(r'no images for 2\d s; nothing on /image ', running.diagnosis()[1]),
        'a warning',
    )
    assert running.diagnosis()[0] == 1
    running.send('image', small_camera.image(1))
    running.spin_until(lambda: running.diagnosis()[:2] == (0, 'tracking, 2 modes'), 'an end')


def status_lines(world):
    """Lines that the node has logged as information, since it became active."""
    world.logged += world.stderr.readouterr().err
    lines = re.findall(r'^\[INFO\] \[[0-9.]+\] \[filter_node\]: (.*)$', world.logged, re.MULTILINE)
    return lines[1 + next(i for i, line in enumerate(lines) if 'waits for' in line) :]


def test_status_line(running, small_camera, stub_tracker):
    """It is logged at once, then after ten diagnostics periods with input."""
    period = running.own_periods()
    period()
    assert status_lines(running) == []
    running.send('camera_info', small_camera.info())
    running.send('image', small_camera.image(0))
    for _ in range(3):
        period()
    start, line = status_lines(running)
    assert start.startswith('track 1 starts from ')
    number = r'\d+\.\d'
    assert re.fullmatch(
        rf'tracking, 2 modes; {number} images a second, {number} tracked, latency \d+ ms', line
    )
    for index in range(1, 11):
        assert status_lines(running) == [start, line]
        running.send('image', small_camera.image(index))
        period()
        period()
    assert len(status_lines(running)) == 3
    # Another status is logged at once.
    image = small_camera.image(11)
    stub_tracker.empty.add(image.header.stamp.sec * 10**9 + image.header.stamp.nanosec)
    running.send('image', image)
    period()
    period()
    *_, last = status_lines(running)
    assert not last.startswith('tracking')


def test_what_diagnostics_tell_is_what_the_page_says(running, small_camera):
    """docs/nodes.md explains every key, and no others."""
    running.send('camera_info', small_camera.info())
    running.send('camera_info', small_camera.uncalibrated())
    running.send('image', small_camera.image(0))
    running.event('/image', 'MESSAGE_LOST', total_count_change=1)
    running.event('/image', 'INCOMPATIBLE_QOS', total_count_change=1, last_policy_kind=16)
    running.event('/tf', 'INCOMPATIBLE_QOS', total_count_change=1, last_policy_kind=2)
    running.patience(0.0)
    page = (ROOT / 'docs' / 'nodes.md').read_text('utf-8')
    table = page.partition('## Diagnostics')[2].partition('| key |')[2]
    cells = [line.split('|')[1] for line in table.partition('\n\n')[0].splitlines()[2:]]
    explained = {key for cell in cells for key in re.findall('`([^`]+)`', cell)}
    patterns = {
        key: re.compile(r'[\w/~]+'.join(re.escape(text) for text in re.split(r'<\w+>', key)))
        for key in explained
    }
    # Keys of this node only.
    own = {'misfit', 'evaluations of the likelihood', 'probability that a person is in view'}
    running.spin_until(lambda: 'nothing on /image' in running.diagnosis()[2], 'all of it')
    keys = running.diagnosis()[2].keys() - own
    assert [key for key in keys if not any(p.fullmatch(key) for p in patterns.values())] == []
    assert [key for key, p in patterns.items() if not any(map(p.fullmatch, keys))] == []


def test_messages_beyond_the_limit_are_not_even_read(running, small_camera, monkeypatch):
    running.send('camera_info', small_camera.info())
    wanted = list(running.node._wanted_inputs())
    assert {one.source: one.largest for one in wanted} == {
        'camera_info': 2**24,
        'depth': 4 * 2**26 + 2**16,
        'keypoints': 2**24,
        'keypoints_3d': 2**24,
        'mask': 2**26 + 2**16,
        'mask/compressed': 2**26 + 2**16,
        'pose_prediction': 2**24,
        'image': 8 * 2**26 + 2**16,
    }
    small = [one._replace(largest=5000) for one in wanted]
    monkeypatch.setattr(running.node, '_wanted_inputs', lambda: small)
    assert running.change_state('deactivate')
    assert running.change_state('activate')
    running.connect()
    running.publishers['image'].publish(running.of_ros(small_camera.image(0)))
    running.spin_until(lambda: running.handled[-1].source == 'image', 'an answer')
    assert re.fullmatch(
        r'message of image can not be read: it has 9\d{3} bytes, the limit is 5000',
        running.handled[-1].faults[0],
    )
