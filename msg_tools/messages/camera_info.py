"""Converts sensor_msgs/CameraInfo to a camera and back.

The calibration in the message is for the full sensor. The picture may show only a part of the
sensor (roi), and may be binned: a pixel u of the sensor is at (u - roi.x_offset) / binning_x in the
picture, the convention of image_geometry.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.body.camera import unfolded_share
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_types import MessageFactory

# Number of distortion coefficients by model; without distortion all are 0.
_COEFFICIENTS = {'plumb_bob': 5, 'rational_polynomial': 8, 'equidistant': 4}
# Synonyms for the models. The distortion model of a pinhole camera follows from the number of
# coefficients, as in OpenCV.
_PINHOLE = ('pinhole', 'perspective', 'none')
_ALIASES = {
    'radtan': 'plumb_bob',
    'brown_conrady': 'plumb_bob',
    'brown-conrady': 'plumb_bob',
    'fisheye': 'equidistant',
    'equi': 'equidistant',
    'kannala_brandt': 'equidistant',
    'kannala_brandt4': 'equidistant',
}
# Maximum skew that is ignored, in focal lengths; it moves image borders by up to about 2 px.
_MAX_SKEW = 0.01

# Limits of a valid calibration: ratio of focal lengths and principal point to the size of the
# picture, and absolute value of distortion coefficients.
_MAX_RATIO = 1000.0
_MAX_COEFFICIENT = 1e6


class CameraInfoError(ValueError):
    """A camera info is invalid; the message is one line with the actual and the required value."""


class UncalibratedError(CameraInfoError):
    """The camera of a camera info is not calibrated."""


def camera_from_info(
    message: Any,
    image_size: tuple[int, int] | None = None,
    notify: Callable[[str], object] = lambda text: None,
) -> Camera:
    """Converts a camera info to a camera.

    Args:
        message: sensor_msgs/CameraInfo, of `rosbags` or of ROS.
        image_size: (width, height) of the pictures, px; a calibration for a different size is
            scaled if the aspect ratio is the same.
        notify: called with a line of text for each approximation.

    Raises:
        CameraInfoError: the camera is not calibrated, values are not finite or are inconsistent, or
            the distortion model is unknown.
    """
    k = [float(value) for value in message.k]
    d = [float(value) for value in message.d]
    if len(k) != 9:
        raise CameraInfoError(f'camera info: K has {len(k)} values, wanted 9')
    if k[0] == 0.0:
        raise UncalibratedError('camera info has k[0] = 0: uncalibrated')
    if not all(math.isfinite(value) for value in (*k, *d)):
        raise CameraInfoError('camera info: K or D has values that are not finite')
    if k[0] < 0.0 or k[4] <= 0.0:
        raise CameraInfoError(f'camera info: focal lengths are {k[0]} and {k[4]}, wanted positive')
    if abs(k[1]) >= _MAX_SKEW * k[0] or k[3] != 0.0 or k[6:] != [0.0, 0.0, 1.0]:
        raise CameraInfoError(
            f'camera info: K is {k}, wanted [fx, 0, cx, 0, fy, cy, 0, 0, 1] with a skew K[1] below '
            f'{_MAX_SKEW * k[0]:.3g}; calibrate with the skew fixed at 0'
        )
    if k[1] != 0.0:
        notify(f'camera info: the skew of K, {k[1]:.3g} of {k[0]:.4g} pixels, is taken for 0')
    model, coefficients = _distortion(str(message.distortion_model), d)
    x, y, width, height = _region(message)
    _check_plausible(k, coefficients, max(width, height))
    binning_x, binning_y = max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    width, height = width // binning_x, height // binning_y
    if width < 1 or height < 1:
        raise CameraInfoError(
            f'camera info: binning of {binning_x} and {binning_y} leaves {width}x{height} pixels'
        )
    try:
        camera = Camera(
            fx=k[0] / binning_x,
            fy=k[4] / binning_y,
            cx=(k[2] - x) / binning_x,
            cy=(k[5] - y) / binning_y,
            width=width,
            height=height,
            distortion=coefficients,
            distortion_model=model,
        )
        if (share := unfolded_share(camera)) < 1.0:
            notify(
                f'camera info: beyond {share:.0%} of the way to a corner the distortion folds or '
                'overstretches the image, and positions are wrong; calibrate with the pattern '
                'there'
            )
        if image_size is None or tuple(image_size) == (width, height):
            return camera
        wide, high = image_size
        scaled = camera.scaled(wide, high)
    except ValueError as error:
        raise CameraInfoError(f'camera info: {error}') from error
    notify(
        f'camera info: the calibration for images of {width}x{height} pixels is scaled to '
        f'{wide}x{high}; it is wrong if these are cropped from larger ones'
    )
    return scaled


def _check_plausible(k: list[float], coefficients: tuple[float, ...], size: int) -> None:
    """Raises CameraInfoError for implausible numbers, which could overflow when squared."""
    low, high = size / _MAX_RATIO, size * _MAX_RATIO
    if not (low < k[0] < high and low < k[4] < high):
        raise CameraInfoError(
            f'camera info: focal lengths are {k[0]:g} and {k[4]:g}, wanted {low:g} to {high:g} '
            f'for {size} pixels'
        )
    if max(abs(k[2]), abs(k[5])) > high:
        raise CameraInfoError(
            f'camera info: principal point is ({k[2]:g}, {k[5]:g}), wanted at most {high:g}'
        )
    if any(abs(value) > _MAX_COEFFICIENT for value in coefficients):
        raise CameraInfoError(
            f'camera info: D has a coefficient of {max(coefficients, key=abs):g}, wanted at most '
            f'{_MAX_COEFFICIENT:g}'
        )


def _distortion(model: str, coefficients: list[float]) -> tuple[str, tuple[float, ...]]:
    model = _ALIASES.get(model.lower(), model)
    if model.lower() in _PINHOLE:
        model = 'plumb_bob' if len(coefficients) < 8 else 'rational_polynomial'
    if model == 'plumb_bob' and not any(coefficients[5:]):
        coefficients = coefficients[:5]
    if not any(coefficients):
        if model not in ('', 'plumb_bob', 'rational_polynomial', 'equidistant'):
            raise CameraInfoError(f'camera info: unknown distortion model {model!r}')
        if model == 'equidistant':
            # Without coefficients this model is an ideal fisheye, not a pinhole.
            raise CameraInfoError('camera info: equidistant without coefficients is not supported')
        return 'plumb_bob', ()
    if model == '':
        raise CameraInfoError(
            f'camera info: D has {len(coefficients)} coefficients, but no distortion model'
        )
    if model == 'rational_polynomial' and not any(coefficients[8:]):
        # Remove the thin prism and tilt coefficients that OpenCV appends.
        coefficients = coefficients[:8]
    return model, tuple(coefficients)


def _region(message: Any) -> tuple[int, int, int, int]:
    """Offset and size, px, of the sensor region that the picture shows."""
    width, height = int(message.width), int(message.height)
    if width < 1 or height < 1:
        raise CameraInfoError(f'camera info: size is {width}x{height}, wanted that of the picture')
    roi = message.roi
    x, y = int(roi.x_offset), int(roi.y_offset)
    roi_width, roi_height = int(roi.width), int(roi.height)
    if roi_width == 0 and roi_height == 0 and x == 0 and y == 0:
        return 0, 0, width, height
    if roi_width < 1 or roi_height < 1 or x + roi_width > width or y + roi_height > height:
        raise CameraInfoError(
            f'camera info: roi of {roi_width}x{roi_height} at ({x}, {y}) does not lie in the '
            f'{width}x{height} of the sensor'
        )
    return x, y, roi_width, roi_height


def camera_info_message(
    messages: MessageFactory, camera: Camera, stamp_ns: int, frame_id: str
) -> Any:
    """sensor_msgs/CameraInfo of a camera, without roi and binning."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    return messages.create(
        'sensor_msgs/msg/CameraInfo',
        header=header_message(messages, stamp_ns, frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.distortion_model,
        d=np.array(camera.distortion or (0.0,) * _COEFFICIENTS[camera.distortion_model]),
        k=np.array(k),
        r=np.eye(3).reshape(-1),
        p=np.hstack([np.reshape(k, (3, 3)), np.zeros((3, 1))]).reshape(-1),
    )
