"""camera_node: images of a webcam or of a video file, with a calibration; a simple driver.

    ros2 run hmt_ros camera_node /dev/video0 --fov 60
    ros2 run hmt_ros camera_node walk.mp4 --calibration camera.yaml --ros-args -r __ns:=/camera
    ros2 run hmt_ros camera_node walk.mp4 --ros-args -p loop:=true -p rate:=0.5

It publishes `image_raw` and `camera_info` with the sensor data QoS. The stamp of an image is the
time at which it was read or, in a file, is due. Without a calibration or a field of view that of a
common camera is assumed. An unplugged device is opened again as soon as it is back. A file starts
once the nodes in the parameter `wait_for` are active or, if it is empty, once somebody subscribes
to the images; the node ends with the file.
"""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import rclpy
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from hmt_ros.body import Camera
from hmt_ros.inference.arrays import Image
from hmt_ros.nodes.node_parameters import declare
from hmt_ros.nodes.run_node import described
from hmt_ros.nodes.signals import on_signals
from hmt_ros.sessions.camera_file import camera_of_view, read_camera
from hmt_ros.sessions.declared_parameters import AT_LAUNCH, parameter_field
from hmt_ros.sessions.focal_length import USUAL_FOV, usual_camera
from msg_tools import RosbagsMessages
from msg_tools.files.display_matrix import IDENTITY, display_matrix, is_mirrored
from msg_tools.files.error_line import error_line
from msg_tools.files.video_file import open_video
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.images import image_message

NAME = 'camera_node'
FRAME_ID = 'camera_optical_frame'
# Image rate assumed for files that do not specify a rate, 1/s.
_USUAL_RATE = 30.0
# Time without an image after which a webcam is considered unplugged, and interval between attempts
# to open it again, s.
_UNPLUGGED_TIME, _REOPENING_INTERVAL = 5.0, 1.0
_POLLING_PERIOD, _CONNECTION_TIME = 0.05, 0.5
# Time limit for discovering the subscription of an active node, s: middleware participants
# announce themselves every 3 s.
_DISCOVERY_TIME = 5.0
# Interval between reports on nodes that are not active yet, s.
_REPORT_INTERVAL = 10.0


@dataclass(frozen=True)
class CameraNodeParameters:
    """Parameters of the node.

    Attributes:
        wait_for: Names of the lifecycle nodes that must be active before a file begins, separated
            by blanks; if empty, it begins with the first subscriber.
        loop: If true, a file begins again at its end; its stamps go on.
        rate: Factor on the speed at which a file is shown; its stamps stay as far apart as in the
            file.
    """

    wait_for: str = parameter_field('', AT_LAUNCH)
    loop: bool = parameter_field(False, AT_LAUNCH)
    rate: float = parameter_field(1.0, AT_LAUNCH, (0.01, 100.0))


class Video:
    """A webcam or a video file.

    Args:
        source: '/dev/video0', the number of a device, or the path of a file.
        loop, speed: values of the parameters `loop` and `rate`; ignored for a webcam.

    Attributes:
        is_file: whether the source is a file.

    Raises:
        ValueError: the source can not be opened or used (one-line message).
    """

    def __init__(self, source: str, *, loop: bool = False, speed: float = 1.0) -> None:
        number = source.removeprefix('/dev/video')
        self.is_file = not number.isdecimal()
        self._source, self._loop, self._speed = source, loop, speed
        if self.is_file and not Path(source).is_file():
            raise ValueError(f'{source}: no such file; wanted a video, or /dev/video0')
        self._device = -1 if self.is_file else int(number)
        self._capture = open_video(Path(source)) if self.is_file else cv2.VideoCapture(self._device)
        if not self._capture.isOpened():
            raise ValueError(
                f'{source} can not be opened; wanted a webcam that no other program uses'
            )
        if self.is_file and is_mirrored(display_matrix(Path(source)) or IDENTITY):
            # OpenCV would rotate mirrored images by 180 degrees.
            raise ValueError(
                f'{source}: its metadata mirror the images; convert it with ffmpeg -i {source} '
                'shown.mp4'
            )
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self._rate = rate if math.isfinite(rate) and rate > 0.0 else _USUAL_RATE

    def images(
        self, stopped: threading.Event, warn: Callable[[str], Any]
    ) -> Iterator[tuple[Image, int | None]]:
        """Images (H, W, 3) BGR with their times since the first image of a file, ns, or None.

        Args:
            stopped: event that ends the iteration.
            warn: function that receives a message when the webcam is unplugged or back.
        """
        start, number, seen, again, gone = time.monotonic(), 0, time.monotonic(), 0, False
        while not stopped.is_set():
            read, image = self._capture.read()
            if read:
                if self.is_file:
                    at = start + number / (self._rate * self._speed)
                    stopped.wait(max(at - time.monotonic(), 0.0))
                due = round(number * SECOND_NS / self._rate) if self.is_file else None
                number, seen = number + 1, time.monotonic()
                if gone:
                    warn(f'{self._source} is back')
                    gone = False
                yield image, due  # type: ignore[misc]
            elif self.is_file and self._loop and number > again:
                again = number
                self._capture.open(self._source)
            elif self.is_file:
                return
            elif time.monotonic() - seen > _UNPLUGGED_TIME:
                if not gone:
                    warn(
                        f'{self._source} has given no image for {_UNPLUGGED_TIME:g} s: is it '
                        'plugged in, and not used by another program? The node continues as '
                        'soon as it is back'
                    )
                    gone = True
                self._capture.release()
                stopped.wait(_REOPENING_INTERVAL)
                self._capture.open(self._device)
            else:
                stopped.wait(_POLLING_PERIOD)

    def close(self) -> None:
        """Releases the device."""
        self._capture.release()


def main(args: list[str] | None = None) -> int:
    """Publishes until the video ends or a signal arrives; returns 0, or 1 after an error."""
    arguments = sys.argv[1:] if args is None else args
    stopped = threading.Event()
    on_signals(lambda *_: stopped.set())
    try:
        given = _parser().parse_args(remove_ros_args([NAME, *arguments])[1:])
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node(NAME)
        p = declare(node, CameraNodeParameters())
        video = Video(given.video, loop=p.loop, speed=p.rate)
        try:
            _show(node, video, given, p.wait_for.split(), stopped)
        finally:
            video.close()
    except Exception as error:  # noqa: BLE001 - whatever it is given, the node says why it ends
        sys.stderr.write(f'{NAME}: {error_line(error)}\n')
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f'ros2 run hmt_ros {NAME}',
        description=__doc__,
        epilog='\n'.join(['parameters:', *described(CameraNodeParameters())]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('video', help='/dev/video0, the number of a device, or a video file')
    view = parser.add_mutually_exclusive_group()
    view.add_argument(
        '--fov', type=_angle, metavar='DEGREES', help='field of view from left to right'
    )
    view.add_argument(
        '--calibration',
        type=Path,
        metavar='FILE',
        help='calibration file, as import-video --camera takes it',
    )
    parser.add_argument('--frame-id', default=FRAME_ID, help=f'frame_id of the images ({FRAME_ID})')
    return parser


def _angle(text: str) -> float:
    angle = float(text)
    if not 1.0 <= angle <= 170.0:
        raise argparse.ArgumentTypeError(f'{text} degrees: wanted an angle from 1 to 170')
    return angle


def _await_active(node: Any, names: list[str], stopped: threading.Event) -> None:
    """Waits until the named lifecycle nodes are active, or until `stopped` is set."""
    from lifecycle_msgs.msg import State
    from lifecycle_msgs.srv import GetState

    clients = {name: node.create_client(GetState, f'{name}/get_state') for name in names}
    told = time.monotonic()
    while clients and not stopped.is_set():
        for name, client in [*clients.items()]:
            if not client.service_is_ready():
                continue
            answer = client.call_async(GetState.Request())
            rclpy.spin_until_future_complete(node, answer, timeout_sec=_CONNECTION_TIME)
            if answer.done() and answer.result().current_state.id == State.PRIMARY_STATE_ACTIVE:
                node.destroy_client(clients.pop(name))
        if time.monotonic() - told > _REPORT_INTERVAL:
            told = time.monotonic()
            node.get_logger().info(f'not active yet: {", ".join(clients)}; see "ros2 node list"')
        stopped.wait(_POLLING_PERIOD)


def _await_subscriber(node: Any, images: Any, stopped: threading.Event, patience: float) -> None:
    """Waits up to `patience` s for a subscriber to the images, or until `stopped` is set."""
    end = time.monotonic() + patience
    while not images.get_subscription_count() and not stopped.is_set() and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=_POLLING_PERIOD)


def _show(
    node: Any,
    video: Video,
    given: argparse.Namespace,
    wait_for: list[str],
    stopped: threading.Event,
) -> None:
    from sensor_msgs.msg import CameraInfo
    from sensor_msgs.msg import Image as ImageMessage

    images = node.create_publisher(ImageMessage, 'image_raw', qos_profile_sensor_data)
    infos = node.create_publisher(CameraInfo, 'camera_info', qos_profile_sensor_data)
    if video.is_file and wait_for:
        node.get_logger().info(f'{given.video} starts when active: {", ".join(wait_for)}')
        _await_active(node, wait_for, stopped)
        _await_subscriber(node, images, stopped, _DISCOVERY_TIME)
    elif video.is_file and not images.get_subscription_count():
        node.get_logger().info(f'{given.video} starts when somebody subscribes to {images.topic}')
        _await_subscriber(node, images, stopped, math.inf)
    if video.is_file:
        # The subscriber may not have discovered the publisher yet.
        stopped.wait(_CONNECTION_TIME)
    camera, messages, count, first = None, RosbagsMessages(), 0, 0
    for image, due in video.images(stopped, node.get_logger().warn):
        if due is None or camera is None:
            first = node.get_clock().now().nanoseconds
        stamp = first + (due or 0)
        if camera is None:
            camera = _camera(node, given, (image.shape[1], image.shape[0]))
        info = camera_info_message(messages, camera, stamp, given.frame_id)
        infos.publish(serialise(info))
        if images.get_subscription_count():
            images.publish(serialise(image_message(messages, image, stamp, given.frame_id)))
        # Answers requests for the parameters of the node.
        rclpy.spin_once(node, timeout_sec=0.0)
        count += 1
    over = '' if stopped.is_set() or not video.is_file else '; the file is over'
    node.get_logger().info(f'{given.video}: {count} images shown{over}')


def _camera(node: Any, given: argparse.Namespace, size: tuple[int, int]) -> Camera:
    """The camera from a calibration or field of view; warns if the field of view is assumed."""
    if given.calibration is not None:
        return read_camera(given.calibration, size, node.get_logger().warn)
    if given.fov is None:
        node.get_logger().warn(
            'neither --calibration nor --fov is given: the field of view is assumed to be '
            f'{USUAL_FOV:g} degrees along the longer side; distances have the relative error of '
            'the focal length, see focal_length_sigma of filter_node'
        )
        return usual_camera(size)
    return camera_of_view(size, horizontal=given.fov)


if __name__ == '__main__':
    sys.exit(main())
