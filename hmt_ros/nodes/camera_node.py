"""camera_node: images of a webcam or of a video file, with a calibration; a simple driver.

    ros2 run hmt_ros camera_node /dev/video0 --fov 60
    ros2 run hmt_ros camera_node walk.mp4 --calibration camera.yaml --ros-args -r __ns:=/camera

It publishes `image_raw` and `camera_info`, as sensor data. A file is shown at its own rate once
somebody subscribes to its images; the node ends with it. The stamp of an image is the time at which
it was read, or is due in the file. Where nothing tells the field of view it is taken to be that of
a common webcam.
"""

from __future__ import annotations

import argparse
import math
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import rclpy
from rclpy.qos import qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from hmt_ros.body import Camera
from hmt_ros.inference.arrays import Image
from hmt_ros.nodes.signals import on_signals
from hmt_ros.sessions.camera_file import camera_of_view, read_camera
from msg_tools import RosbagsMessages
from msg_tools.files.display_matrix import STORED, display_matrix, is_mirrored
from msg_tools.files.error_line import error_line
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.images import image_message

NAME = 'camera_node'
FRAME_ID = 'camera_optical_frame'
# Field of view of a common webcam from left to right, degrees.
USUAL_FOV = 60.0
# Images a second of a file that does not give its rate.
_USUAL_RATE = 30.0
# Time without an image after which a device counts as gone, s.
_PATIENCE = 5.0
_GLANCE, _CONNECTING = 0.05, 0.5


class CameraError(ValueError):
    """A device or a file can not be used; one line."""


class Video:
    """A webcam or a video file.

    Args:
        source: '/dev/video0', the number of a device, or the path of a file.

    Attributes:
        is_file: whether it is a file, which has an end.

    Raises:
        CameraError: it can not be opened.
    """

    def __init__(self, source: str) -> None:
        number = source.removeprefix('/dev/video')
        self.is_file = not number.isdecimal()
        self._source = source
        if self.is_file and not Path(source).is_file():
            raise CameraError(f'{source}: no such file; wanted a video, or /dev/video0')
        self._capture = cv2.VideoCapture(source if self.is_file else int(number))
        if not self._capture.isOpened():
            kind = 'a video that OpenCV reads' if self.is_file else 'a webcam that nobody uses'
            raise CameraError(f'{source} can not be opened; wanted {kind}')
        if self.is_file and is_mirrored(display_matrix(Path(source)) or STORED):
            # OpenCV would turn it by 180 degrees.
            raise CameraError(
                f'{source}: its metadata mirror the images; write them as players show them, by '
                f'ffmpeg -i {source} shown.mp4'
            )
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self._rate = rate if math.isfinite(rate) and rate > 0.0 else _USUAL_RATE

    def images(self, stopped: threading.Event) -> Iterator[tuple[Image, int | None]]:
        """The images, (H, W, 3) BGR, and when they are due after the first of a file, ns.

        Raises:
            CameraError: a device gives none any more.
        """
        start, number, seen = time.monotonic(), 0, time.monotonic()
        while not stopped.is_set():
            read, image = self._capture.read()
            if read:
                if self.is_file:
                    stopped.wait(max(start + number / self._rate - time.monotonic(), 0.0))
                due = round(number * SECOND_NS / self._rate) if self.is_file else None
                number, seen = number + 1, time.monotonic()
                yield image, due  # type: ignore[misc]
            elif self.is_file:
                return
            elif time.monotonic() - seen > _PATIENCE:
                raise CameraError(f'{self._source} has given no image for {_PATIENCE:g} s')
            else:
                stopped.wait(_GLANCE)

    def close(self) -> None:
        """Gives the device back."""
        self._capture.release()


def main(args: list[str] | None = None) -> int:
    """Publishes until the video ends or a signal comes; returns 0, or 1 without a camera."""
    arguments = sys.argv[1:] if args is None else args
    given = _parser().parse_args(remove_ros_args([NAME, *arguments])[1:])
    stopped = threading.Event()
    on_signals(lambda *_: stopped.set())
    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(NAME)
    try:
        video = Video(given.video)
        try:
            _show(node, video, given, stopped)
        finally:
            video.close()
    except ValueError as error:
        sys.stderr.write(f'{NAME}: {error_line(error)}\n')
        return 1
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f'ros2 run hmt_ros {NAME}',
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument('video', help='/dev/video0, the number of a device, or a video file')
    view = parser.add_mutually_exclusive_group()
    view.add_argument(
        '--fov', type=_angle, metavar='DEGREES', help='field of view from left to right'
    )
    view.add_argument(
        '--calibration', type=Path, metavar='FILE',
        help='calibration file, as import-video --camera takes it',
    )  # fmt: skip
    parser.add_argument('--frame-id', default=FRAME_ID, help=f'of the images ({FRAME_ID})')
    return parser


def _angle(text: str) -> float:
    angle = float(text)
    if not 1.0 <= angle <= 170.0:
        raise argparse.ArgumentTypeError(f'{text} degrees: wanted an angle from 1 to 170')
    return angle


def _show(node: Any, video: Video, given: argparse.Namespace, stopped: threading.Event) -> None:
    from sensor_msgs.msg import CameraInfo
    from sensor_msgs.msg import Image as ImageMessage

    images = node.create_publisher(ImageMessage, 'image_raw', qos_profile_sensor_data)
    infos = node.create_publisher(CameraInfo, 'camera_info', qos_profile_sensor_data)
    if video.is_file and not images.get_subscription_count():
        node.get_logger().info(f'{given.video} starts when somebody subscribes to {images.topic}')
    while video.is_file and not images.get_subscription_count() and not stopped.is_set():
        stopped.wait(_GLANCE)
    if video.is_file:
        # The other side may not know yet that it is connected.
        stopped.wait(_CONNECTING)
    camera, messages, count, first = None, RosbagsMessages(), 0, 0
    for image, due in video.images(stopped):
        if due is None or camera is None:
            first = node.get_clock().now().nanoseconds
        stamp = first + (due or 0)
        if camera is None:
            camera = _camera(node, given, (image.shape[1], image.shape[0]))
        info = camera_info_message(messages, camera, stamp, given.frame_id)
        infos.publish(serialise(info))
        if images.get_subscription_count():
            images.publish(serialise(image_message(messages, image, stamp, given.frame_id)))
        count += 1
    node.get_logger().info(f'{given.video}: {count} images shown')


def _camera(node: Any, given: argparse.Namespace, size: tuple[int, int]) -> Camera:
    """The calibration; a warning where it is assumed."""
    if given.calibration is not None:
        return read_camera(given.calibration, size, node.get_logger().warn)
    if given.fov is None:
        node.get_logger().warn(
            f'neither --calibration nor --fov is given: the field of view is taken to be '
            f'{USUAL_FOV:g} degrees; distances are wrong by as much as that is'
        )
    return camera_of_view(size, horizontal=given.fov or USUAL_FOV)


if __name__ == '__main__':
    sys.exit(main())
