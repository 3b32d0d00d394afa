"""The camera of images: from its field of view, or from a calibration file.

Calibration files are those of OpenCV (FileStorage: YAML, XML or JSON) and those of ROS
(camera_calibration, or a camera_info as `ros2 topic echo --once` prints it).
"""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

from hmt_ros.body import Camera
from hmt_ros.inference.arrays import Array
from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.plain_yaml import load_plain_yaml
from msg_tools.messages.camera_info import CameraInfoError, camera_from_info

LARGEST_FILE = 1_000_000  # bytes
# Names of the entries of an OpenCV file in several programs.
_MATRIX = ('camera_matrix', 'Camera_Matrix', 'cameraMatrix', 'K', 'M1')
_DISTORTION = (
    'distortion_coefficients', 'Distortion_Coefficients', 'distCoeffs', 'dist_coeffs', 'D', 'D1',
)  # fmt: skip
_WIDTH, _HEIGHT = ('image_width', 'image_Width'), ('image_height', 'image_Height')
_HEADS = ('%YAML', '<?xml', '{')


def camera_of_view(
    size: tuple[int, int], horizontal: float | None = None, vertical: float | None = None
) -> Camera:
    """A camera with square pixels whose axis meets the middle of the image.

    Args:
        size: width and height of the image, px.
        horizontal: angle from the left border to the right, degrees; or
        vertical: angle from the upper border to the lower, degrees.
    """
    width, height = size
    side, angle = (width, horizontal) if horizontal is not None else (height, vertical)
    assert angle is not None
    focal = 0.5 * side / math.tan(math.radians(angle) / 2)
    return Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def read_camera(path: Path, size: tuple[int, int]) -> Camera:
    """The camera that a calibration file describes.

    Args:
        size: width and height of the images, px; the file must be for the same.

    Raises:
        ValueError: no calibration in the file, a damaged one, or one for another size.
    """
    try:
        text = read_bytes(path, LARGEST_FILE).decode('utf-8')
        entries = _of_opencv(text, size) if text.lstrip().startswith(_HEADS) else _of_ros(text)
        return camera_from_info(SimpleNamespace(**entries), size)
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error


def _of_opencv(text: str, size: tuple[int, int]) -> dict[str, Any]:
    """Entries of a camera_info, from a file of OpenCV; one without a size is for the images."""
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    except (cv2.error, SystemError) as error:
        raise ValueError('not a file of OpenCV (FileStorage)') from error

    def node(names: tuple[str, ...]) -> Any:
        found = (storage.getNode(name) for name in names)
        return next((x for x in found if not x.empty()), None)

    def matrix(names: tuple[str, ...]) -> Array | None:
        found = node(names)
        value = None if found is None else found.mat()
        return None if value is None else np.asarray(value, dtype=np.float64)

    def whole(names: tuple[str, ...], otherwise: int) -> int:
        found = node(names)
        return otherwise if found is None else int(found.real())

    k, d = matrix(_MATRIX), matrix(_DISTORTION)
    if k is None or k.shape != (3, 3):
        raise ValueError(f'no 3x3 matrix under one of the names {", ".join(_MATRIX)}')
    coefficients = [] if d is None else [float(x) for x in d.reshape(-1)]
    fisheye = node(('fisheye_model',))
    model = 'rational_polynomial' if len(coefficients) > 5 else 'plumb_bob'
    if fisheye is not None and fisheye.real():
        model = 'equidistant'
    return _entries(
        k.reshape(-1), coefficients, model, whole(_WIDTH, size[0]), whole(_HEIGHT, size[1])
    )


def _of_ros(text: str) -> dict[str, Any]:
    """Entries of a camera_info, from a file of ROS."""
    content = load_plain_yaml(text.strip().removesuffix('---'))
    if not isinstance(content, dict):
        raise ValueError('not a calibration: wanted a file of OpenCV or a camera_info of ROS')
    if 'camera_matrix' in content:
        k, d = (_data(content, x) for x in ('camera_matrix', 'distortion_coefficients'))
        width, height = content.get('image_width'), content.get('image_height')
    elif 'k' in content:
        k, d = content['k'], content.get('d', [])
        width, height = content.get('width'), content.get('height')
    else:
        raise ValueError('no calibration: neither camera_matrix nor k is in it')
    values = [width, height, *(k if isinstance(k, list) else [None])]
    values += d if isinstance(d, list) else [None]
    if not all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in values):
        raise ValueError('not a calibration: its sizes, matrix and coefficients must be numbers')
    entries = _entries(k, d, str(content.get('distortion_model', '')), width, height)
    region, binning = content.get('roi'), ('binning_x', 'binning_y')
    if isinstance(region, dict):
        vars(entries['roi']).update({str(name): value for name, value in region.items()})
    return entries | {name: content[name] for name in binning if name in content}


def _data(content: dict[Any, Any], name: str) -> Any:
    entry = content.get(name)
    return entry.get('data') if isinstance(entry, dict) else entry or []


def _entries(k: Any, d: Any, model: str, width: Any, height: Any) -> dict[str, Any]:
    if not (math.isfinite(width) and math.isfinite(height)):
        raise CameraInfoError(f'size is {width}x{height}, wanted that of the picture')
    region = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    return {
        'k': k, 'd': d, 'distortion_model': model, 'width': int(width), 'height': int(height),
        'roi': region, 'binning_x': 0, 'binning_y': 0,
    }  # fmt: skip
