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
    d = [0.1, 0.1, 0.001, 0.001, 0.1, 0.1, 0.1, 0.1]
    eight = read_camera(of_opencv(tmp_path / 'a.yaml', d), SIZE)
    assert eight.distortion_model == 'rational_polynomial'
    fish = read_camera(of_opencv(tmp_path / 'b.yaml', [0.1] * 4, fisheye_model=1), SIZE)
    assert fish.distortion_model == 'equidistant'


D = (-0.2, 0.1, 0.001, -0.002)
KALIBR = """\
cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.2, 0.1, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [500.0, 510.0, 320.5, 239.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
TOML = """\
[cam_0]
name = "left"
size = [ 640.0, 480.0,]
matrix = [ [ 500.0, 0.0, 320.5,], [ 0.0, 510.0, 239.0,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.2, 0.1, 0.001, -0.002,]
rotation = [ 0.1, 0.2, 0.3,]
fisheye = false

[metadata]
adjusted = false
"""
OTHERS = {
    'exponents.yaml': ROS.replace(', 0.0]}', ', 1e-05]}'),
    'several.yaml': ECHO + ECHO.replace('500.0', '700.0'),
    'rostopic.yaml': ECHO.replace('d: [', 'D: [').replace('k: [', 'K: [').replace(', 0.0]', ']', 1),
    'camchain.yaml': KALIBR,
    'Calib.toml': TOML,
    'plain.json': (
        '{"K": [[500, 0, 320.5], [0, 510, 239], [0, 0, 1]], "dist_coeffs": [-0.2, 0.1, 0.001, '
        '-0.002]}'
    ),
}


@pytest.mark.parametrize('name', OTHERS)
def test_files_of_other_programs(name, tmp_path):
    told = []
    camera = read_camera(write(tmp_path / name, OTHERS[name]), SIZE, told.append)
    assert np.array_equal(camera.matrix, K)
    assert camera.distortion[:4] == D
    assert camera.distortion_model == 'plumb_bob'
    assert not told


@pytest.mark.parametrize(
    ('name', 'text'),
    [
        ('kalibr.yaml', KALIBR.replace('radtan', 'equi')),
        ('anipose.toml', TOML.replace('fisheye = false', 'fisheye = true')),
        (
            'narrow.yaml',
            ROS.replace('distortion_model: plumb_bob', 'camera_model: fisheye')
            .replace('cols: 5', 'cols: 4')
            .replace('-0.002, 0.0]', '-0.002]'),
        ),
    ],
)
def test_fisheyes_of_other_programs(name, text, tmp_path):
    camera = read_camera(write(tmp_path / name, text), SIZE)
    assert camera.distortion_model == 'equidistant'
    assert camera.distortion == D


def test_one_camera_of_several(tmp_path):
    second = TOML.replace('cam_0', 'cam_1').replace('510.0', '520.0').partition('[metadata]')[0]
    path = write(tmp_path / 'calib.toml', second + TOML)
    with pytest.raises(ValueError, match=r'cam_1, cam_0: name one, as .*calib\.toml:cam_1$'):
        read_camera(path, SIZE)
    with pytest.raises(ValueError, match='cam_1, cam_0: name one'):
        read_camera(tmp_path / 'calib.toml:cam_2', SIZE)
    assert read_camera(tmp_path / 'calib.toml:cam_0', SIZE).fy == 510.0
    assert read_camera(tmp_path / 'calib.toml:cam_1', SIZE).fy == 520.0
    write(path, second.replace('left', 'right') + TOML)
    assert read_camera(tmp_path / 'calib.toml:right', SIZE).fy == 520.0
    write(tmp_path / 'one.toml', TOML)
    assert read_camera(tmp_path / 'one.toml:left', SIZE).fy == 510.0
    with pytest.raises(ValueError, match=r'cam_0: name one, as .*one\.toml:cam_0$'):
        read_camera(tmp_path / 'one.toml:right', SIZE)


def test_calibration_for_another_size_is_scaled_and_told(tmp_path):
    told = []
    path = write(tmp_path / 'camera.yaml', ROS)
    whole, half = read_camera(path, SIZE), read_camera(path, (320, 240), told.append)
    points = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 2.0]])
    # The border of the first pixel is at -0.5 in both.
    assert np.allclose(2 * (half.project(points) + 0.5), whole.project(points) + 0.5)
    assert len(told) == 1
    assert 'images of 640x480 pixels is scaled to 320x240' in told[0]


def test_distortion_that_folds_is_refused(tmp_path):
    text = ROS.replace('[-0.2, 0.1, 0.001, -0.002, 0.0]', '[-5, 30, 0, 0, 0]')
    with pytest.raises(ValueError, match='folds or overstretches the image of 640x480 pixels'):
        read_camera(write(tmp_path / 'camera.yaml', text), SIZE)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (
            KALIBR.replace('pinhole', 'omni').replace('[500', '[0.9, 500'),
            "unknown distortion model 'omni'",
        ),
        (KALIBR.replace('pinhole', 'omni'), "unknown distortion model 'omni'"),
        (KALIBR.replace('radtan', 'fov'), "unknown distortion model 'fov'"),
        (KALIBR.replace('[640, 480]', '[640]'), r'size is \[640\.0\], wanted width and height'),
        (
            ROS.replace('image_height: 480', 'image_height: 400'),
            'is for images of 640x400 pixels, which have another shape than 640x480',
        ),
        (
            ROS.replace('camera_matrix', 'camera'),
            'no calibration: none of the names camera_matrix, .* is in it',
        ),
        (ROS.replace('320.5', 'wide'), 'its sizes, matrix and coefficients must be numbers'),
        (ROS.replace('data: [500', 'data: [0'), 'uncalibrated'),
        ('just words', 'no calibration: none of the names'),
        ('a: [', 'while parsing'),
        ('%YAML:1.0\n---\nnothing: 1\n', 'no calibration: none of the names'),
        ('{ "damaged', 'not JSON'),
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


def test_stereo_files_of_opencv(tmp_path):
    """Matrices of integers and floats, several cameras, and invalid numbers elsewhere."""
    for suffix in ('yaml', 'xml', 'json'):
        path = tmp_path / f'stereo.{suffix}'
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
        storage.writeComment('of { two: [ cameras', False)
        storage.write('calibration_time', "Fri 27 Nov 'noon' # [1]: 10:00")
        storage.write('errors', np.array([[np.nan, -np.inf, 1e-9]]))
        storage.write('image_points', np.arange(4000.0).reshape(2000, 2))
        for i, kind in enumerate((np.int32, np.float32)):
            storage.startWriteStruct(f'cam{i}', cv2.FileNode_MAP)
            storage.write('M1', np.array([[500, 0, 320], [0, 510 + i, 239], [0, 0, 1]], kind))
            storage.write('D1', np.array([[-0.25, 1e-7, 0.0, 0.0, 0.0]], np.float64))
            storage.write('fisheye_model', 0)
            storage.endWriteStruct()
        storage.release()
        with pytest.raises(ValueError, match='cam0, cam1: name one'):
            read_camera(path, SIZE)
        camera = read_camera(tmp_path / f'stereo.{suffix}:cam1', SIZE)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 511, 320, 239)
        assert camera.distortion == (-0.25, 1e-7, 0.0, 0.0, 0.0)
        assert camera.distortion_model == 'plumb_bob'


HEAD = '%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n'
ENTITIES = '<!DOCTYPE a [<!ENTITY b "x"><!ENTITY c "&b;&b;">]>'
NUMBERS = 'must be numbers'
HOSTILE = {
    'deep.yaml': ('%YAML:1.0\n---\na: ' + '[' * 50_000, 'nested deeper than 50 levels'),
    'deep.xml': ('<?xml version="1.0"?>' + '<a>' * 50_000 + '</a>' * 50_000, 'recursion'),
    'deep.json': ('{"a": ' + '[' * 50_000, 'not JSON .nested too deep.'),
    'blank.json': ('{' + '\n' * 500_000 + '}', 'no calibration'),
    'deep.toml': ('a = ' + '[' * 50_000, 'recursion'),
    'parts.toml': ('a' + '.a' * 50_000 + ' = 1', 'a line with more than 200 points'),
    'entities.xml': (f'<?xml version="1.0"?>{ENTITIES}<a>&c;</a>', 'XML with a DOCTYPE'),
    'huge.yaml': (HEAD.replace('3', '100000') + '   data: [ 1. ]\n', 'K has 1 values, wanted 9'),
    'type.yaml': (HEAD.replace(': d', ': "1000000000d"') + '   data: [ 1. ]\n', 'K has 1 values'),
    'digits.yaml': (f'k: [{"9" * 1500}, 0, 1]', 'a number of 1500 characters'),
    'digits.json': (f'{{"K": [{"9" * 1000}, 0, 1]}}', NUMBERS),
    'digits.toml': (f'K = [0x{"9" * 9000}, 0, 1]', NUMBERS),
    'overflow.toml': (f'K = [0x{"f" * 900}]', NUMBERS),
    'long.yaml': (ROS.replace('-0.2,', '-0.2, ' * 100_000), NUMBERS),
    'long.toml': ('distortions = [' + '1,\n' * 1000 + ']\nK = [1, 2, 3, 4]', NUMBERS),
    'bool.yaml': (ROS.replace('[500, 0', '[500, true'), NUMBERS),
    'text.yaml': (ROS.replace('[500, 0', '[500, x'), NUMBERS),
    'date.toml': ('K = [2020-01-01, 2, 3, 4]', NUMBERS),
    'size.yaml': (ROS.replace('image_width: 640', f'image_width: {10**30}'), 'another shape|focal'),
    'roi.yaml': (ECHO.replace('x_offset: 0', 'x_offset: .inf'), 'infinity'),
    'binning.yaml': (ECHO.replace('binning_x: 0', f'binning_x: {10**60}'), 'leaves 0x'),
    'data.xml': ('<?xml version="1.0"?><a><K><data><x/></data></K></a>', NUMBERS),
    'damaged.xml': ('<?xml version="1.0"?><a', 'not XML'),
}


@pytest.mark.parametrize('name', HOSTILE)
def test_well_formed_hostile_files(name, tmp_path):
    text, message = HOSTILE[name]
    with pytest.raises(ValueError, match=message) as caught:
        read_camera(write(tmp_path / name, text), SIZE)
    assert len(str(caught.value).splitlines()) == 1
