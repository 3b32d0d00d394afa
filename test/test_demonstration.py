"""The demonstration on a small rendered bag, and its pictures."""

import io
import re
import shutil
from contextlib import redirect_stdout

import cv2
import numpy as np
import pytest

from hmt_learning.app import make_bag
from hmt_ros.app.report.skeletons import LEFT_COLOUR, RIGHT_COLOUR
from hmt_ros.app.truth import read_truth
from hmt_ros.evaluation.pose_scores import HIPS
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools import BagReader, BagWriter, RosbagsMessages
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.keypoints import keypoints_message, positions_message
from tools.demonstration.demo import (
    CLIPS,
    DETECTORS,
    NOBODY,
    OURS,
    RATE,
    REGIONS,
    SMOOTHED,
    main,
)

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
    """Output folder, exit code and printed text of the demonstration."""
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
            assert contains(picture, LEFT_COLOUR), name
            assert contains(picture, RIGHT_COLOUR), name


def told(printed):
    """The values about the poses, by name, and the other lines."""
    head, table, rest = printed.split('\n\n', 2)
    rows = {line[:58].strip(): line[58:] for line in table.splitlines()}
    return rows, [*head.splitlines(), *rest.splitlines()]


def millimetres(text):
    value, unit = text.split()
    assert unit == 'mm'
    return float(value)


def test_it_tells_what_came_out(output):
    folder, _, printed = output
    rows, lines = told(printed)
    assert rows.pop('') == 'all images'
    assert list(rows) == [OURS, SMOOTHED, REGIONS, NOBODY, RATE, CLIPS]
    assert 0 < millimetres(rows[OURS]) < 300
    assert rows[REGIONS].endswith(' %')
    assert rows[NOBODY] == '0 of 5 images'
    assert float(rows[RATE]) > 0
    assert re.fullmatch(r"\d\d mm; detector's 3D \d\d\d", rows[CLIPS])
    assert lines[-1] == f'open in a browser: {folder / "report" / "report.html"}'
    for name in (*(f'report/{picture}' for picture in PICTURES), 'report/report.html', 'small'):
        assert any(line.startswith(f'{folder / name}: ') for line in lines), name


def test_a_detector_is_beside_ours(source, tmp_path):
    """Compared with a detector's own 3D, here exact except for 1 cm of depth at the left knee."""
    truth, scheme = read_truth(source / 'truth.npz'), schemes()['mediapipe33']
    bag, messages = tmp_path / 'detected', RosbagsMessages()
    with BagReader(source) as old, BagWriter(bag) as new:
        for stored in old.messages(['/image/compressed', '/camera_info', '/ground_truth', '/body']):
            new.write(stored.topic, stored.log_time_ns, stored.message)
        camera = camera_from_info(next(old.messages(['/camera_info'])).message)
        for stamp, joints in truth.joints.items():
            at = [truth.joint_names.index(x) if x in truth.joint_names else 0 for x in scheme.names]
            known = np.array([x in truth.joint_names for x in scheme.names])
            pixels, hips = camera.project(joints[at]), [truth.joint_names.index(x) for x in HIPS]
            positions = joints[at] - joints[hips].mean(0)
            positions[scheme.names.index('left_knee'), 2] += 0.12
            confidences = np.where(known, 0.9, 0.0)
            covariances = np.full((len(at), 2, 2), np.nan)
            found = Keypoints(scheme.names, pixels, covariances, confidences, positions=positions)
            new.write('keypoints', stamp, keypoints_message(messages, found, stamp, 'camera'))
            new.write('keypoints_3d', stamp, positions_message(messages, found, stamp, 'camera'))
    shutil.copy(source / 'background.png', bag)
    # The last image is a second scene.
    with np.load(source / 'truth.npz') as content:
        scenes = {'scenes': ['stands', 'moves'], 'until': content['stamps'][[4, 4]]}
        np.savez(bag / 'truth.npz', **content, **scenes)
    printed = io.StringIO()
    with redirect_stdout(printed):
        assert main([str(bag), '-o', str(tmp_path / 'out')]) == 0
    rows, _ = told(printed.getvalue())
    assert rows.pop('').split() == ['stands', 'moves']
    assert list(rows) == [DETECTORS, OURS, SMOOTHED, REGIONS, NOBODY, RATE, CLIPS]
    assert rows[DETECTORS].split() == ['10', 'mm', '10', 'mm']
    assert all(millimetres(rows[OURS][i : i + 8]) < 100 for i in (0, 8))
