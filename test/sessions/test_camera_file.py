import cv2
import numpy as np
import pytest

from hmt_ros.sessions.camera_file import camera_of_view, read_camera

K = np.array([[500.0, 0.0, 320.5], [0.0, 510.0, 239.0], [0.0, 0.0, 1.0]])
SIZE = (640, 480)
ROS = """\
image_width: 640
image_height: 480
camera_name: narrow
camera_matrix: {rows: 3, cols: 3, data: [500, 0, 320.5, 0, 510, 239, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.2, 0.1, 0.001, -0.002, 0.0]}
"""
ECHO = """\
header: {stamp: {sec: 1, nanosec: 2}, frame_id: camera}
height: 480
width: 640
distortion_model: plumb_bob
d: [-0.2, 0.1, 0.001, -0.002, 0.0]
k: [500.0, 0.0, 320.5, 0.0, 510.0, 239.0, 0.0, 0.0, 1.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""


def write(path, content):
    path.write_text(content, 'utf-8')
    return path


def of_opencv(path, d, **entries):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write('camera_matrix', K)
    storage.write('distortion_coefficients', np.array([d]))
    for name, value in entries.items():
        storage.write(name, value)
    storage.release()
    return path


def test_horizontal_and_vertical_view():
    camera = camera_of_view(SIZE, horizontal=60.0)
    assert camera.fx == camera.fy == pytest.approx(320 / np.tan(np.radians(30)))
    assert (camera.cx, camera.cy) == (319.5, 239.5)
    # The rays through the left and the right border are 60 degrees apart.
    edges = camera.rays([[-0.5, 239.5], [639.5, 239.5]])
    assert np.degrees(np.arccos(edges[0] @ edges[1])) == pytest.approx(60.0)
    vertical = camera_of_view(SIZE, vertical=45.0)
    edges = vertical.rays([[319.5, -0.5], [319.5, 479.5]])
    assert np.degrees(np.arccos(edges[0] @ edges[1])) == pytest.approx(45.0)


@pytest.mark.parametrize('text', [ROS, ECHO])
def test_files_of_ros(text, tmp_path):
    camera = read_camera(write(tmp_path / 'camera.yaml', text), SIZE)
    assert np.array_equal(camera.matrix, K)
    assert camera.distortion == (-0.2, 0.1, 0.001, -0.002, 0.0)
    assert camera.distortion_model == 'plumb_bob'


@pytest.mark.parametrize('suffix', ['yaml', 'xml', 'json'])
def test_files_of_opencv(suffix, tmp_path):
    d = [-0.2, 0.1, 0.001, -0.002, 0.0]
    path = of_opencv(tmp_path / f'camera.{suffix}', d, image_width=640, image_height=480)
    camera = read_camera(path, SIZE)
    assert np.array_equal(camera.matrix, K)
    assert camera.distortion == tuple(d)
    points = np.array([[0.3, -0.2, 2.0]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(d))
    assert np.allclose(camera.project(points), expected[0])


def test_models_of_opencv(tmp_path):
    eight = read_camera(of_opencv(tmp_path / 'a.yaml', [0.1] * 8), SIZE)
    assert eight.distortion_model == 'rational_polynomial'
    fish = read_camera(of_opencv(tmp_path / 'b.yaml', [0.1] * 4, fisheye_model=1), SIZE)
    assert fish.distortion_model == 'equidistant'


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (ROS.replace('640', '1280'), 'camera info is for pictures of 1280x480, saw 640x480'),
        (ROS.replace('camera_matrix', 'matrix'), 'neither camera_matrix nor k is in it'),
        (ROS.replace('320.5', 'wide'), 'its sizes, matrix and coefficients must be numbers'),
        (ROS.replace('data: [500', 'data: [0'), 'uncalibrated'),
        ('just words', 'not a calibration: wanted a file of OpenCV or a camera_info'),
        ('a: [', 'while parsing'),
        ('%YAML:1.0\n---\nnothing: 1\n', 'no 3x3 matrix under one of the names camera_matrix'),
        ('{ "damaged', 'not a file of OpenCV'),
    ],
)
def test_bad_files(text, message, tmp_path):
    path = write(tmp_path / 'camera.yaml', text)
    with pytest.raises(ValueError, match=message) as caught:
        read_camera(path, SIZE)
    assert str(caught.value).startswith(f'{path}: ')
    assert '\n' not in str(caught.value)
    with pytest.raises(ValueError, match='can not be read'):
        read_camera(tmp_path / 'missing.yaml', SIZE)
