"""The driver of a webcam, with a file in its place."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest

from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image
from test.nodes.conftest import PATIENCE, ROOT

pytestmark = pytest.mark.ros


def started(*arguments):
    return subprocess.Popen(
        [sys.executable, '-m', 'hmt_ros.nodes.camera_node', *arguments], cwd=ROOT,
        env=dict(os.environ), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


@pytest.fixture
def shown(walk_video):
    """Runs the node with a listener: what it published, and what it said."""
    import rclpy
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image

    def run(*options):
        context = rclpy.Context()
        rclpy.init(context=context)
        node = rclpy.create_node('listener', context=context)
        executor = rclpy.executors.SingleThreadedExecutor(context=context)
        executor.add_node(node)
        arrived = {'image_raw': [], 'camera_info': []}
        kinds = {'image_raw': Image, 'camera_info': CameraInfo}
        for topic, kind in kinds.items():
            into = arrived[topic].append
            node.create_subscription(
                kind, f'/lab/{topic}', into, qos_profile_sensor_data, raw=True
            )  # fmt: skip
        process = started(str(walk_video / 'walk.mp4'), *options, '--ros-args', '-r', '__ns:=/lab')
        end = time.monotonic() + PATIENCE
        while process.poll() is None and time.monotonic() < end:
            executor.spin_once(timeout_sec=0.05)
        for _ in range(20):
            executor.spin_once(timeout_sec=0.01)
        node.destroy_node()
        rclpy.shutdown(context=context)
        types = {'image_raw': 'sensor_msgs/msg/Image', 'camera_info': 'sensor_msgs/msg/CameraInfo'}
        read = {
            topic: [deserialise(data, types[topic]) for data in messages]
            for topic, messages in arrived.items()
        }
        assert process.returncode == 0
        return read, process.stdout.read()

    return run


def test_a_file_is_shown_at_its_rate_with_the_calibration_of_its_view(shown):
    read, said = shown('--fov', '60')
    images, infos = read['image_raw'], read['camera_info']
    # The middleware may still be matching the calibration when the first image goes out.
    assert len(images) >= 7
    stamps = [time_ns(message.header.stamp) for message in images]
    assert set(np.diff(stamps)) <= {100_000_000, 200_000_000}
    assert set(stamps) & {time_ns(message.header.stamp) for message in infos}
    assert decode_image(images[0]).shape == (240, 320, 3)
    camera = camera_from_info(infos[0])
    assert (camera.width, camera.height) == (320, 240)
    assert camera.fx == pytest.approx(160 / np.tan(np.radians(30)))
    assert {message.header.frame_id for message in [*images, *infos]} == {'camera_optical_frame'}
    assert 'walk.mp4: 8 images shown' in said
    assert 'assumed' not in said


def test_an_unknown_field_of_view_is_told(shown):
    read, said = shown('--frame-id', 'eye')
    assert read['image_raw'][0].header.frame_id == 'eye'
    assert said.count('neither --calibration nor --fov is given') == 1
    assert 'taken to be 60 degrees' in said


@pytest.mark.parametrize(
    ('arguments', 'code', 'text'),
    [
        (['nowhere.mp4'], 1, 'camera_node: nowhere.mp4: no such file; wanted a video, or /dev/'),
        (['README.md'], 1, 'camera_node: README.md can not be opened; wanted a video that OpenCV'),
        (['/dev/video87'], 1, '/dev/video87 can not be opened; wanted a webcam that nobody uses'),
        (['a.mp4', '--fov', '200'], 2, '200 degrees: wanted an angle from 1 to 170'),
        (['a.mp4', '--fov', '60', '--calibration', 'x'], 2, 'not allowed with argument --fov'),
    ],
)
def test_a_camera_that_can_not_be_used(arguments, code, text):
    process = started(*arguments)
    output, _ = process.communicate(timeout=PATIENCE)
    assert (process.returncode, 'Traceback' in output) == (code, False)
    assert text in output
