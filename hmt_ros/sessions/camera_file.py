"""Camera from a field of view, or from a calibration file.

A calibration file comes from OpenCV (FileStorage: YAML, XML or JSON), from ROS (camera_calibration,
or a camera_info printed by `ros2 topic echo --once` or `rostopic echo -n1`), from kalibr
(camchain), or from anipose, Pose2Sim or caliscope (`.toml`).
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree as ET

from hmt_ros.body import Camera
from hmt_ros.body.camera import tangent
from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.error_line import error_line
from msg_tools.files.plain_json import load_plain_json
from msg_tools.files.plain_yaml import load_plain_yaml
from msg_tools.messages.camera_info import camera_from_info

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_FILE_BYTES = 1_000_000  # bytes
# Names of the same entry in the files of different programs.
_MATRIX_KEYS = (
    'camera_matrix',
    'Camera_Matrix',
    'cameraMatrix',
    'K',
    'k',
    'M1',
    'matrix',
    'intrinsics',
)
_DISTORTION_KEYS = (
    'distortion_coefficients',
    'Distortion_Coefficients',
    'distCoeffs',
    'dist_coeffs',
    'D',
    'd',
    'D1',
    'distortions',
    'distortion_coeffs',
)
_WIDTH, _HEIGHT = (
    ('image_width', 'image_Width', 'width'),
    ('image_height', 'image_Height', 'height'),
)
_SIZE = ('size', 'resolution')
_FISHEYE = ('fisheye', 'fisheye_model')
_TAG_OF_OPENCV = re.compile(r'(?<=[:-] )!{1,2}<?opencv-[\w-]+>?')
# A list that is too long for the matrix or the distortion of a camera.
_LONG_LIST = re.compile(r'\[[^][]{2000,}\]')
_MAX_MATRIX_VALUES = 100  # maximum number of values of a matrix or a distortion
_MAX_DOTS = 200  # maximum number of dots in a line: parsing of dotted TOML keys is quadratic

Notify = Callable[[str], object]


def camera_of_view(
    size: tuple[int, int],
    horizontal: float | None = None,
    vertical: float | None = None,
    aspect: float = 1.0,
) -> Camera:
    """Return a camera whose optical axis passes through the centre of the image.

    Args:
        size: width and height of the image, px.
        horizontal: horizontal field of view, degrees; None selects `vertical`.
        vertical: vertical field of view, degrees; ignored if `horizontal` is given.
        aspect: width of a pixel over its height.
    """
    width, height = size
    side, angle = (width, horizontal) if horizontal is not None else (height, vertical)
    assert angle is not None
    focal = 0.5 * side / tangent(math.radians(angle) / 2)
    fx, fy = (focal, focal * aspect) if horizontal is not None else (focal / aspect, focal)
    return Camera(fx, fy, (width - 1) / 2, (height - 1) / 2, width, height)


def read_camera(path: Path, size: tuple[int, int], notify: Notify = lambda text: None) -> Camera:
    """Read the camera of a calibration file.

    Args:
        path: the file; FILE:NAME selects the camera NAME if the file has several cameras.
        size: width and height of the images, px; a calibration for another size of the same aspect
            ratio is scaled, and a calibration without a size is assumed to be for this size.
        notify: function that receives a line about each entry that is ignored or scaled.

    Raises:
        ValueError: the calibration is missing, damaged, or for another aspect ratio.
    """
    file, name = path, ''
    if not path.exists() and ':' in path.name:
        head, _, name = str(path).rpartition(':')
        file = Path(head)
    try:
        found, model = _content(file, read_bytes(file, MAX_FILE_BYTES).decode('utf-8'))
        calibrations = _calibrations(found)
        if not calibrations:
            raise ValueError(
                f'no calibration: none of the names {", ".join(_MATRIX_KEYS)} is in it'
            )
        named = {str(x.get('name')): x for x in calibrations.values()} | calibrations
        if name not in named and (name or len(calibrations) > 1):
            some = next(iter(calibrations))
            raise ValueError(
                f'calibrations of the cameras {", ".join(calibrations)}: name one, as {file}:{some}'
            )
        entries = _entries(named.get(name, next(iter(calibrations.values()))), model, size)
        return camera_from_info(SimpleNamespace(**entries), size, lambda x: notify(f'{path}: {x}'))
    except (ValueError, TypeError, ArithmeticError, RecursionError) as error:
        raise ValueError(f'{path}: {error_line(error)}') from error


def _content(path: Path, text: str) -> tuple[Any, str]:
    """Return the entries of a file, and the default distortion model."""
    if path.suffix.lower() == '.toml':
        if any(line.count('.') > _MAX_DOTS for line in text.splitlines()):
            raise ValueError(f'a line with more than {_MAX_DOTS} points')
        return tomllib.loads(text), 'pinhole'
    start = text.lstrip()
    if start.startswith('<?xml'):
        return _of_xml(start), 'pinhole'
    # Removes long lists that are not needed, such as the points of a calibration pattern.
    text = _LONG_LIST.sub('"a long list"', start)
    of_opencv = start.startswith(('%YAML', '{'))
    if of_opencv:
        text = text.replace("\\'", "'")
    if start.startswith('{'):
        text = re.sub(r'^[ \t]*//.*$', '', text, flags=re.MULTILINE)
        return load_plain_json(re.sub(r'(?<=[\s\[,])-?\.(Nan|Inf)\b', 'NaN', text)), 'pinhole'
    if of_opencv:
        text = _TAG_OF_OPENCV.sub('', text.partition('\n')[2])
    # An echoed topic has a line --- after each message; the first message is used.
    first = re.split('^---', text.strip().removeprefix('---'), flags=re.MULTILINE)[0]
    return load_plain_yaml(first), 'pinhole' if of_opencv else ''


def _of_xml(text: str) -> Any:
    """Return the entries of an XML file of OpenCV, with numbers as strings."""
    if '<!DOCTYPE' in text or '<!ENTITY' in text:
        raise ValueError('XML with a DOCTYPE, wanted a file of OpenCV')
    try:
        return _of_element(ET.fromstring(text))
    except ET.ParseError as error:
        raise ValueError(f'not XML ({error})') from error


def _of_element(element: ET.Element) -> Any:
    if len(element):
        entries = [_of_element(child) for child in element]
        named = dict(zip([child.tag for child in element], entries, strict=True))
        return entries if '_' in named else named
    words = [word.strip('"') for word in (element.text or '').split()]
    return words[0] if len(words) == 1 else words


def _calibrations(content: Any, name: str = '') -> dict[str, dict[Any, Any]]:
    """Return the tables of a file that contain a camera matrix, by name."""
    if not isinstance(content, dict):
        return {}
    if _first(content, _MATRIX_KEYS) is not None:
        return {name: content}
    return {k: v for x in content for k, v in _calibrations(content[x], str(x)).items()}


def _entries(content: dict[Any, Any], model: str, size: tuple[int, int]) -> dict[str, Any]:
    """Return the fields of a camera_info, from a table with a calibration.

    Args:
        model: default distortion model.
    """
    k, d = (
        _numbers(_first(content, _MATRIX_KEYS)),
        _numbers(_first(content, _DISTORTION_KEYS) or []),
    )
    if 4 <= len(k) <= 6:  # kalibr: other models than the pinhole have parameters before these
        fx, fy, cx, cy = k[-4:]
        k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    given = _first(content, _WIDTH), _first(content, _HEIGHT)
    sides = _numbers(
        _first(content, _SIZE) or [size[i] if x is None else x for i, x in enumerate(given)]
    )
    if len(sides) != 2 or not all(math.isfinite(x) for x in sides):
        raise ValueError(f'size is {sides}, wanted width and height of the images')
    lens = str(content.get('camera_model') or 'pinhole')
    if _first(content, _FISHEYE) not in (None, 0, '0'):
        model = 'fisheye'
    elif lens.lower() != 'pinhole':
        model = lens
    else:
        model = str(content.get('distortion_model') or model)
    region = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    if isinstance(content.get('roi'), dict):
        vars(region).update({str(name): value for name, value in content['roi'].items()})
    return {
        'k': k,
        'd': d,
        'distortion_model': model,
        'width': int(sides[0]),
        'height': int(sides[1]),
        'roi': region,
        'binning_x': content.get('binning_x') or 0,
        'binning_y': content.get('binning_y') or 0,
    }


def _first(content: dict[Any, Any], names: tuple[str, ...]) -> Any:
    """Return the entry of the first name that is present; None if no name is present."""
    return next((content[name] for name in names if content.get(name) is not None), None)


def _numbers(value: Any) -> list[float]:
    """Return the numbers of a list, of a list of rows, or of the `data` of a matrix."""
    if isinstance(value, dict):
        value = value.get('data')
    rows = value if isinstance(value, list) else [value]
    values = [x for row in rows for x in (row if isinstance(row, list) else [row])]
    try:
        # YAML reads 1e-05, without a point, as a string.
        if len(values) <= _MAX_MATRIX_VALUES and not any(isinstance(x, bool) for x in values):
            return [float(x) for x in values]
        seen = f'{len(values)} values'
    except (TypeError, ValueError, OverflowError) as error:
        seen = error_line(error)
    text = 'not a calibration: its sizes, matrix and coefficients must be numbers'
    raise ValueError(f'{text} ({seen[:100]})')
