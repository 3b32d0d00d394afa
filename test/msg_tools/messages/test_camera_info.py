"""CameraInfo to a camera: messages of real drivers, and invalid ones."""

import re
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from hmt_ros.body import Camera
from msg_tools.messages.camera_info import CameraInfoError, camera_from_info, camera_info_message

K = [600.0, 0.0, 321.5, 0.0, 590.0, 243.25, 0.0, 0.0, 1.0]
PLUMB_BOB = [-0.25, 0.08, 0.001, -0.002, 0.01]
RATIONAL = [0.5, -0.3, 0.001, 0.0005, 0.05, 0.9, -0.2, 0.01]
EQUIDISTANT = [0.05, -0.01, 0.003, -0.0005]


def info(**changes):
    roi = {'x_offset': 0, 'y_offset': 0, 'width': 0, 'height': 0, 'do_rectify': False}
    roi.update(changes.pop('roi', {}))
    fields: dict[str, Any] = {
        'width': 640,
        'height': 480,
        'distortion_model': 'plumb_bob',
        'd': PLUMB_BOB,
        'k': K,
        'binning_x': 0,
        'binning_y': 0,
        'roi': SimpleNamespace(**roi),
    }
    return SimpleNamespace(**{**fields, **changes})


@pytest.mark.parametrize(
    ('model', 'coefficients'),
    [
        ('plumb_bob', []),
        ('plumb_bob', PLUMB_BOB),
        ('plumb_bob', PLUMB_BOB[:4]),
        ('plumb_bob', [0.0] * 5),
        ('', []),
        ('', [0.0] * 5),
        ('rational_polynomial', RATIONAL),
        ('rational_polynomial', [*RATIONAL, 0.0, 0.0, 0.0, 0.0]),
        ('rational_polynomial', [0.0] * 14),
        ('plumb_bob', [*PLUMB_BOB, 0.0, 0.0, 0.0]),
    ],
)
def test_projects_as_opencv(model, coefficients):
    camera = camera_from_info(info(distortion_model=model, d=np.array(coefficients)))
    points = np.random.default_rng(0).uniform([-1, -1, 2], [1, 1, 5], (50, 3))
    matrix = np.reshape(K, (3, 3))
    wanted, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))
    np.testing.assert_allclose(camera.project(points), wanted[:, 0], atol=1e-8)
    assert (camera.width, camera.height) == (640, 480)


def test_fisheye_projects_as_opencv():
    camera = camera_from_info(info(distortion_model='equidistant', d=EQUIDISTANT))
    points = np.random.default_rng(0).uniform([-3, -3, 1], [3, 3, 3], (50, 3))
    matrix = np.reshape(K, (3, 3))
    wanted, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), matrix, np.array(EQUIDISTANT)
    )
    np.testing.assert_allclose(camera.project(points), wanted[:, 0], atol=1e-8)


def test_a_distortion_that_folds_in_the_corners_is_told():
    told: list[str] = []
    camera_from_info(info(d=np.array([0.17, -0.3, 0.0, 0.0, 0.0])), notify=told.append)
    assert told == []
    camera_from_info(info(d=np.array([-0.34, 0.0, 0.0, 0.0, 0.0])), notify=told.append)
    (line,) = told
    # It folds at 2 / 3 of the ideal radius, where 1 - 1.02 r^2 is 0; a corner lies at 0.677.
    assert re.search('beyond 9[678]% of the way to a corner', line)


def test_region_and_binning():
    roi = {'x_offset': 100, 'y_offset': 50, 'width': 400, 'height': 300}
    whole = camera_from_info(info())
    part = camera_from_info(info(roi=roi, binning_x=2, binning_y=4))
    assert (part.width, part.height) == (200, 75)
    points = np.random.default_rng(0).uniform([-0.5, -0.5, 2], [0.5, 0.5, 5], (50, 3))
    wanted = (whole.project(points) - [100, 50]) / [2, 4]
    np.testing.assert_allclose(part.project(points), wanted, atol=1e-9)
    same = camera_from_info(info(roi={'width': 640, 'height': 480}, binning_x=1, binning_y=1))
    assert same == whole


def test_size_of_the_picture():
    assert camera_from_info(info(), (640, 480)).width == 640
    told: list[str] = []
    assert camera_from_info(info(), (320, 240), told.append).fx == 300.0
    assert len(told) == 1
    assert 'for images of 640x480 pixels is scaled to 320x240' in told[0]
    with pytest.raises(CameraInfoError, match='640x480 pixels, which have another shape than 320x'):
        camera_from_info(info(), (320, 200))
    assert camera_from_info(info(binning_x=2, binning_y=2), (320, 240)).fx == 300.0


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'k': [0.0] * 9}, r'k\[0\] = 0: uncalibrated'),
        ({'k': K[:8]}, r'K has 8 values, wanted 9'),
        ({'k': [np.nan, *K[1:]]}, r'values that are not finite'),
        ({'d': [np.inf, 0, 0, 0, 0]}, r'values that are not finite'),
        ({'k': [-600.0, *K[1:]]}, r'focal lengths are -600.0 and 590.0, wanted positive'),
        ({'k': [*K[:4], 0.0, *K[5:]]}, r'focal lengths are 600.0 and 0.0'),
        ({'k': [600.0, 6.0, *K[2:]]}, r'with a skew K\[1\] below 6; calibrate'),
        ({'k': [*K[:8], 0.0]}, r'wanted \[fx, 0, cx, 0, fy, cy, 0, 0, 1\]'),
        ({'width': 0}, r'size is 0x480'),
        ({'height': 0, 'width': 0}, r'size is 0x0'),
        ({'distortion_model': 'omni'}, r"unknown distortion model 'omni'"),
        ({'distortion_model': 'omni', 'd': []}, r"unknown distortion model 'omni'"),
        ({'distortion_model': ''}, r'D has 5 coefficients, but no distortion model'),
        ({'d': PLUMB_BOB[:3]}, r'plumb_bob has \(0, 4, 5\) coefficients, saw 3'),
        ({'distortion_model': 'equidistant', 'd': []}, r'equidistant without coefficients'),
        ({'distortion_model': 'rational_polynomial', 'd': RATIONAL + [0.1] * 4}, r'saw 12'),
        ({'roi': {'x_offset': 600, 'width': 100, 'height': 100}}, r'roi of 100x100 at \(600, 0\)'),
        ({'roi': {'x_offset': 10}}, r'roi of 0x0 at \(10, 0\) does not lie in the 640x480'),
        ({'binning_x': 1000}, r'binning of 1000 and 1 leaves 0x480 pixels'),
        ({'k': [1e-3, 0, 320, 0, 590.0, 240, 0, 0, 1]}, 'focal lengths are 0.001 and 590, wanted'),
        ({'k': [600.0, 0, 1e300, 0, 590.0, 240, 0, 0, 1]}, 'principal point'),
        ({'d': [1e9, 0, 0, 0, 0]}, 'coefficient of 1e'),
    ],
)
def test_what_gives_no_camera(changes, error):
    with pytest.raises(CameraInfoError, match=error) as caught:
        camera_from_info(info(**changes))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('model', 'coefficients'),
    [
        ('plumb_bob', ()),
        ('plumb_bob', tuple(PLUMB_BOB)),
        ('rational_polynomial', tuple(RATIONAL)),
        ('equidistant', tuple(EQUIDISTANT)),
    ],
)
def test_round_trip(messages, model, coefficients):
    camera = Camera(600.0, 590.0, 321.5, 243.25, 640, 480, coefficients, model)
    message = camera_info_message(messages, camera, 5, 'camera')
    assert camera_from_info(message) == camera
    assert message.p.tolist() == [600.0, 0, 321.5, 0, 0, 590.0, 243.25, 0, 0, 0, 1, 0]
    assert message.r.tolist() == np.eye(3).ravel().tolist()
    assert message.header.frame_id == 'camera'
