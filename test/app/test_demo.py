"""The demonstration on a small rendered bag, and what it draws."""

import io
from contextlib import redirect_stdout

import cv2
import numpy as np
import pytest

from hmt_ros.app import make_bag
from hmt_ros.app.demo import main
from hmt_ros.app.report.mixtures import Layer, Moment, read_mixtures
from hmt_ros.app.report.skeletons import LEFT, RIGHT, draw_overview
from hmt_ros.app.truth import read_truth
from hmt_ros.body import Camera
from msg_tools import BagReader

PICTURES = ('overview.png', 'overlays.png', 'side_views.png', 'weights.png', 'calibration.png')


@pytest.fixture(scope='module')
def source(tmp_path_factory):
    """A bag of five images, with its subject file and background."""
    folder = tmp_path_factory.mktemp('bags') / 'small'
    arguments = ['--size', '320x240', '--fps', '10', '--duration', '0.5', '--fov', '40', '--quiet']
    assert make_bag.main(['reach', '-o', str(folder), *arguments]) == 0
    return folder


@pytest.fixture(scope='module')
def output(source, tmp_path_factory):
    """The folder that the demonstration fills, its exit code, and what it prints."""
    folder = tmp_path_factory.mktemp('demo')
    printed = io.StringIO()
    with redirect_stdout(printed):
        code = main([str(source), '-o', str(folder)])
    return folder, code, printed.getvalue()


@pytest.fixture(scope='module')
def truth(source):
    return read_truth(source / 'truth.npz')


def contains(picture, colour):
    """Whether some pixels of a picture have nearly a colour."""
    rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    near = np.abs(picture[..., ::-1].astype(int) - rgb).max(axis=2) < 16
    return near.sum() > 30


def test_it_leaves_a_bag_and_a_report(output):
    folder, code, _ = output
    assert code == 0
    assert sorted(path.name for path in folder.iterdir()) == ['report', 'small']
    assert '<canvas' in (folder / 'report' / 'report.html').read_text('utf-8')
    with BagReader(folder / 'small') as bag:
        assert bag.topic('pose_mixture').message_count == 5
    for name in PICTURES:
        picture = cv2.imread(str(folder / 'report' / name))
        assert min(picture.shape[:2]) > 200, name
        if name not in ('weights.png', 'calibration.png'):
            assert contains(picture, LEFT), name
            assert contains(picture, RIGHT), name


def test_it_tells_what_came_out(output):
    folder, _, printed = output
    lines = printed.splitlines()
    (row,) = (line.split() for line in lines if line.startswith('/pose_mixture'))
    assert row[1] == '5'
    assert float(row[4]) >= float(row[5])  # the heaviest is no better than the best
    (vertical,) = (line for line in lines if line.startswith('/ground: '))
    assert 'errs by 0.0 degrees' in vertical
    for name in (*(f'report/{picture}' for picture in PICTURES), 'report/report.html', 'small'):
        assert any(line.startswith(f'{folder / name}: ') for line in lines), name


def made_up_track(source):
    """A made-up track: the true joints, and the same moved back and forth."""
    truth = read_truth(source / 'truth.npz')
    moments = {}
    for stamp, joints in truth.joints.items():
        shift = np.array([-0.1, 0.0, 0.2])[:, None, None] * [0, 0, 1]
        moments[stamp] = Moment(stamp, np.array([0.6, 0.3, 0.1]), joints + shift)
    return Layer('/pose_mixture', 'posterior', truth.frame_id, truth.joint_names, moments)


def test_the_same_track_gives_the_same_picture(source, truth, tmp_path):
    track = made_up_track(source)
    stamps = list(track.mixtures)[:3]
    camera = Camera(440.0, 440.0, 159.5, 119.5, 320, 240)
    images = {stamp: np.full((240, 320, 3), 99, np.uint8) for stamp in stamps}
    for name in ('a.png', 'b.png'):
        draw_overview(tmp_path / name, track, camera, images, truth)
    first, second = ((tmp_path / name).read_bytes() for name in ('a.png', 'b.png'))
    assert first == second
    assert len(first) < 300_000


def test_recorded_mixtures_are_read_heaviest_first(output):
    layers = read_mixtures(output[0] / 'small').layers
    (track,) = (layer for layer in layers if layer.topic == '/pose_mixture')
    assert len(track.mixtures) == 5
    for moment in track.mixtures.values():
        assert (np.diff(moment.weights) <= 0).all()
        assert moment.joints.shape == (len(moment.weights), len(track.joint_names), 3)


def test_input_that_can_not_be_used(source, tmp_path, capsys):
    cases = {
        'can not be read': [str(tmp_path / 'nowhere'), '-o', str(tmp_path / 'out')],
        'required': [str(source)],
    }
    for wanted, arguments in cases.items():
        assert main(arguments) == 1
        errors = capsys.readouterr().err.splitlines()
        assert len(errors) == 1
        assert wanted in errors[0]
