"""The webcam driver, with a file instead of a webcam."""

from __future__ import annotations

import itertools
import struct
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from hmt_ros.nodes import camera_node
from hmt_ros.sessions.declared_parameters import declared_parameters
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image
from test.nodes.conftest import ROOT

pytestmark = pytest.mark.ros


# Listener process that writes received messages, with their lengths, to two files.
LISTENER = """
import struct, sys, rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
rclpy.init()
node = rclpy.create_node('listener')
for name, kind in (('image_raw', Image), ('camera_info', CameraInfo)):
    file = open(f'{sys.argv[1]}/{name}', 'wb', buffering=0)
    def keep(data, file=file):
        file.write(struct.pack('<I', len(data)) + data)
    node.create_subscription(kind, f'/lab/{name}', keep, qos_profile_sensor_data, raw=True)
rclpy.spin(node)
"""


def messages_in(path, msgtype):
    found, content = [], path.read_bytes()
    while content:
        (length,) = struct.unpack_from('<I', content)
        found.append(deserialise(content[4 : 4 + length], msgtype))
        content = content[4 + length :]
    return found


@pytest.fixture
def shown(walk_video, tmp_path, ended):
    """Runs the node with a listener; returns its messages and its output."""

    def run(*options):
        listener = subprocess.Popen([sys.executable, '-c', LISTENER, str(tmp_path)])
        try:
            words = ['--ros-args', '-r', '__ns:=/lab']
            video = str(walk_video / 'walk.mp4')
            code, _, said = ended('camera_node', video, *options, *words)
            time.sleep(0.5)
        finally:
            listener.kill()
            listener.wait()
        assert code == 0
        images = messages_in(tmp_path / 'image_raw', 'sensor_msgs/msg/Image')
        infos = messages_in(tmp_path / 'camera_info', 'sensor_msgs/msg/CameraInfo')
        return {'image_raw': images, 'camera_info': infos}, said

    return run


def test_a_file_is_shown_at_its_rate_with_the_calibration_of_its_view(shown):
    read, said = shown('--fov', '60')
    images, infos = read['image_raw'], read['camera_info']
    # With sensor-data QoS the first messages may be lost during connection.
    assert len(images) >= 6
    stamps = [time_ns(message.header.stamp) for message in images]
    assert set(np.diff(stamps)) <= {100_000_000, 200_000_000}
    assert set(stamps) & {time_ns(message.header.stamp) for message in infos}
    assert decode_image(images[0]).shape == (240, 320, 3)
    camera = camera_from_info(infos[0])
    assert (camera.width, camera.height) == (320, 240)
    assert camera.fx == pytest.approx(160 / np.tan(np.radians(30)))
    assert {message.header.frame_id for message in [*images, *infos]} == {'camera_optical_frame'}
    assert 'walk.mp4: 8 images shown; the file is over' in said
    assert 'assumed' not in said


def test_an_unknown_field_of_view_is_told(shown):
    read, said = shown('--frame-id', 'eye')
    assert read['image_raw'][0].header.frame_id == 'eye'
    assert said.count('neither --calibration nor --fov is given') == 1
    assert 'assumed to be 60 degrees' in said


@pytest.mark.parametrize(
    ('arguments', 'code', 'text'),
    [
        (['nowhere.mp4'], 1, 'camera_node: nowhere.mp4: no such file; wanted a video, or /dev/'),
        (['README.md'], 1, 'camera_node: README.md is not a video that OpenCV can read'),
        (
            ['/dev/video87'],
            1,
            '/dev/video87 can not be opened; wanted a webcam that no other program uses',
        ),
        (['a.mp4', '--fov', '200'], 2, '200 degrees: wanted an angle from 1 to 170'),
        (['a.mp4', '--fov', '60', '--calibration', 'x'], 2, 'not allowed with argument --fov'),
    ],
)
def test_a_camera_that_can_not_be_used(arguments, code, text, ended, monkeypatch):
    monkeypatch.chdir(ROOT)
    found, _, errors = ended('camera_node', *arguments)
    assert found == code
    assert text in errors


def test_a_mirrored_file_is_refused(walk_video, tmp_path, ended):
    """OpenCV would rotate it by 180 degrees."""
    content = bytearray((walk_video / 'walk.mp4').read_bytes())
    at = content.index(b'tkhd') + 44
    struct.pack_into('>i', content, at, -struct.unpack_from('>i', content, at)[0])
    path = tmp_path / 'selfie.mp4'
    path.write_bytes(content)
    code, _, errors = ended('camera_node', str(path), '--fov', '60')
    assert code == 1
    assert f'{path}: its metadata mirror the images; convert it with ffmpeg' in errors


# A lifecycle node in its own process that activates itself long after a listener has started.
LATE = """
import sys, time, rclpy
from rclpy.lifecycle import LifecycleNode
rclpy.init()
node = LifecycleNode('late', namespace='/lab')
node.trigger_configure()
end = None
while end is None or time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
    if end is None and node.count_subscribers('/lab/image_raw'):
        end = time.monotonic() + 1.0
print(time.time(), flush=True)
node.trigger_activate()
rclpy.spin(node)
"""


def test_a_file_waits_for_nodes_that_are_named(shown):
    """It waits although a listener is present from the beginning."""
    late = subprocess.Popen([sys.executable, '-c', LATE], stdout=subprocess.PIPE, text=True)
    try:
        read, said = shown('--fov', '60', '--ros-args', '-p', 'wait_for:=late', '--')
        active = float(late.stdout.readline())
    finally:
        late.kill()
        late.communicate()
    assert 'walk.mp4 starts when active: late' in said
    assert len(read['image_raw']) >= 6
    first, last = (time_ns(read['image_raw'][i].header.stamp) * 1e-9 for i in (0, -1))
    assert active < first < last < time.time()


@pytest.fixture
def clip(walk_video, monkeypatch):
    """Images of a file with their due times, s, and the requested waits."""

    def play(count, **options):
        waits = []
        stopped = SimpleNamespace(is_set=lambda: False, wait=waits.append)
        monkeypatch.setattr(camera_node.time, 'monotonic', lambda: 0.0)
        video = camera_node.Video(str(walk_video / 'walk.mp4'), **options)
        shown = list(itertools.islice(video.images(stopped, pytest.fail), count))
        video.close()
        return [image for image, _ in shown], [due * 1e-9 for _, due in shown], waits

    return play


def test_a_file_begins_again_and_its_stamps_go_on(clip):
    images, due, _ = clip(20, loop=True)
    assert np.allclose(due, 0.1 * np.arange(20))
    for i in range(8, 20):
        assert np.array_equal(images[i], images[i - 8])
    assert not np.array_equal(images[0], images[7])
    assert len(clip(20)[0]) == 8


def test_a_file_shown_slowly_keeps_its_times(clip):
    _, due, waits = clip(8, speed=0.5)
    assert np.allclose(due, 0.1 * np.arange(8))
    assert np.allclose(waits, 0.2 * np.arange(8))


def test_parameters_are_described_and_checked(ended):
    code, output, _ = ended('camera_node', '--help')
    assert code == 0
    for name in ('wait_for (string', 'loop (bool', 'rate (float; 0.01 to 100; default 1.0'):
        assert f'  {name}' in output
    page = (ROOT / 'docs' / 'views.md').read_text('utf-8')
    for parameter in declared_parameters(camera_node.CameraNodeParameters()):
        assert f'| `{parameter.name}` |' in page
    for value, text in (('0.0', 'rate'), ("'fast'", 'rate')):
        code, _, errors = ended('camera_node', 'a.mp4', '--ros-args', '-p', f'rate:={value}')
        assert code == 1
        (line,) = errors.splitlines()
        assert line.startswith('camera_node: ')
        assert text in line


class Webcam:
    """Webcam with two images that is then unplugged, and works again when opened a third time."""

    def __init__(self, device):
        self.opened, self.left = [device], 2

    def isOpened(self):  # noqa: N802
        return True

    def get(self, _):
        return 30.0

    def read(self):
        self.left -= 1
        return (True, np.zeros((4, 6, 3), np.uint8)) if self.left >= 0 else (False, None)

    def release(self):
        self.left = 0

    def open(self, device):
        self.opened.append(device)
        self.left = 2 if len(self.opened) == 3 else 0
        return self.left > 0


def test_a_webcam_that_is_plugged_in_again_goes_on(monkeypatch):
    monkeypatch.setattr(camera_node.cv2, 'VideoCapture', Webcam)
    monkeypatch.setattr(camera_node, '_UNPLUGGED_TIME', 0.1)
    monkeypatch.setattr(camera_node, '_REOPENING_INTERVAL', 0.01)
    video, lines = camera_node.Video('/dev/video2'), []
    stopped = threading.Event()
    images = video.images(stopped, lines.append)
    assert [due for _, due in itertools.islice(images, 4)] == [None] * 4
    assert video._capture.opened == [2, 2, 2]
    assert [line.partition(':')[0] for line in lines] == [
        '/dev/video2 has given no image for 0.1 s', '/dev/video2 is back',
    ]  # fmt: skip
    stopped.set()
    assert list(images) == []
