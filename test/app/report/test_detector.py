"""A detector's own skeleton, and regions of joints, in the page of a report."""

import numpy as np
import pytest

from hmt_ros.app.report import command as report
from hmt_ros.image.keypoint_schemes import schemes
from msg_tools import BagReader, BagWriter
from msg_tools.messages.detections import NO_KEYPOINTS
from msg_tools.messages.headers import FRAME_ID, header_message
from msg_tools.messages.keypoints import positions_message
from msg_tools.messages.pose_mixtures import pose_mixture_of
from test.app.conftest import FRAMES, MESSAGES, STAMPS, data_of, make
from test.app.report.test_command import integers, positions

pytestmark = pytest.mark.usefixtures('no_pictures')

NAMES = schemes()['mediapipe33'].names
HIDDEN = 'left_wrist'


def landmarks(joints, names):
    """3D landmarks of a detector exactly at the joints, relative to its own origin."""
    marks = schemes()['mediapipe33'].landmarks
    places = np.zeros((len(marks), 3))
    for i, mark in enumerate(marks):
        if mark.joint:
            places[i] = joints[names.index(mark.joint)]
    hips = [names.index(f'{side}_hip') for side in ('left', 'right')]
    return places - joints[hips].mean(0)


def with_detector(path, source, body, poses, *, topics=('keypoints_3d',), spoil=None, nobody=False):
    """A bag with 3D positions: none in the first image, no wrist in the third."""
    with BagReader(source) as bag, BagWriter(path) as result:
        for stored in bag.messages():
            result.write(stored.topic, stored.log_time_ns, stored.message)
        for i, stamp in enumerate(STAMPS[1:], 1):
            joints = body.joint_positions(poses[i : i + 1])[0]
            places = landmarks(joints, body.joint_names)
            confidences = np.full(len(NAMES), 0.5)
            if i == 2:
                confidences[NAMES.index(HIDDEN)] = 0.0
            message = MESSAGES.create(
                'hmt_msgs/msg/Keypoints3D',
                header=header_message(MESSAGES, stamp, FRAME_ID),
                names=list(NAMES),
                **{axis: places[:, k] for k, axis in enumerate('xyz')},
                confidence=confidences,
            )
            if spoil is not None:
                spoil(message)
            if nobody and i == 3:
                message = positions_message(MESSAGES, NO_KEYPOINTS, stamp, FRAME_ID)
            for topic in topics:
                result.write(topic, stamp, message)
    return path


@pytest.mark.parametrize('where', ['with the mixtures', 'with the images'])
def test_detector_stands_on_the_hips_of_the_heaviest_mode(made, body, poses, tmp_path, where):
    own = where == 'with the mixtures'
    bag = with_detector(tmp_path / 'bag', made.out if own else made.images, body, poses)
    out, images = (bag, made.images) if own else (made.out, bag)
    data = data_of(make(out, tmp_path / 'report', '--images', images))
    seen, layer = data['detector'], data['layers'][0]
    assert seen['topic'] == '/keypoints_3d'
    assert set(seen['joints']) == set(body.joint_names)
    assert seen['known'] == [False, *[True] * (FRAMES - 1)]
    # One of 33 landmarks was not seen.
    assert seen['confidences'] == [None, 0.5, round(0.5 * 32 / 33, 3), *[0.5] * (FRAMES - 3)]
    names, joints = seen['joints'], layer['joints']
    told = positions(data, seen['positions'], FRAMES - 1, len(names))
    hidden = integers(seen['positions']).reshape(told.shape) == -(2**15)
    assert np.argwhere(hidden.all(2)).tolist() == [[1, names.index(HIDDEN)]]
    starts = np.cumsum([len(weights) for weights in layer['weights']])[:-1]
    ours = positions(data, layer['positions'], -1, len(joints))[starts]
    true = body.joint_positions(poses)[1:]

    def hips(points, order):
        return points[:, [order.index('left_hip'), order.index('right_hip')]].mean(1)

    assert np.abs(hips(told, names) - hips(ours, joints)).max() < 1e-3
    for name in ('left_knee', 'right_wrist', 'left_toe', 'right_hand', 'head'):
        expected = true[:, joints.index(name)] - hips(true, joints)
        found = told[:, names.index(name)] - hips(told, names)
        assert np.abs(found - expected).max() < 1e-3


def test_detector_that_can_not_be_shown(made, body, poses, tmp_path, capsys):
    assert data_of(make(made.out, tmp_path / 'none'))['detector'] is None
    others = with_detector(
        tmp_path / 'two', made.out, body, poses, topics=('a/keypoints_3d', 'b/keypoints_3d')
    )
    assert data_of(make(others, tmp_path / 'others'))['detector'] is None

    def without_hips(message):
        message.names = [name.replace('hip', 'thing') for name in message.names]

    no_hips = with_detector(tmp_path / 'hips', made.out, body, poses, spoil=without_hips)
    assert data_of(make(no_hips, tmp_path / 'no_hips'))['detector'] is None

    def shorten(message):
        message.z = message.z[1:]

    bad = with_detector(tmp_path / 'bad', made.out, body, poses, spoil=shorten)
    assert report.main([str(bad), '-o', str(tmp_path / 'new')]) == 1
    line = capsys.readouterr().err
    assert f'/keypoints_3d at {STAMPS[1]} ns: keypoints_3d: z has 32 values, wanted 33' in line


def test_regions_hold_90_percent_of_the_joints(made, data, body):
    (layer,) = (layer for layer in data['layers'] if layer['kind'] == 'posterior')
    with BagReader(made.out) as bag:
        contents = [pose_mixture_of(x.message) for x in bag.messages(['/pose_mixture'])]
    covariances = np.concatenate([content.joint_covariances_relative for content in contents])
    xx, yy, zz, xy, xz, yz = data['region'] * integers(layer['regions']).reshape(-1, 6).T
    roots = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(covariances.shape)
    samples = np.random.default_rng(0).normal(size=(20_000, 3))
    for root, covariance in zip(roots[:2].reshape(-1, 3, 3), covariances.reshape(-1, 3, 3)):
        if np.linalg.eigvalsh(covariance).min() < 1e-8:
            continue
        inside = np.linalg.solve(root, np.linalg.cholesky(covariance) @ samples.T)
        assert abs(np.mean((inside**2).sum(0) < 1) - 0.9) < 0.02
