import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from hmt_learning.app.make_bag import main
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.body import load_body
from hmt_ros.image.subject import read_subject
from hmt_ros.sessions.transform_buffer import TransformBuffer
from msg_tools import BagReader
from msg_tools.messages.images import decode_depth, decode_image

ROOT = Path(__file__).resolve().parents[3]
SHARED = Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared'))
SMALL = ['--size', '160x120', '--fps', '5', '--duration', '0.8', '--quiet']
FILES = ['background.png', 'metadata.yaml', 'small.mcap', 'subject.yaml', 'truth.npz']


def written(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp('bags') / 'small'
    assert main(['reach', '-o', str(folder), *SMALL, '--seed', '3', '--stature', '1.8']) == 0
    return folder


@pytest.fixture(scope='module')
def content(bag):
    messages = {}
    with BagReader(bag) as reader:
        for message in reader.messages():
            messages.setdefault(message.topic.lstrip('/'), []).append(message.message)
    return messages


@pytest.fixture(scope='module')
def truth(bag):
    return np.load(bag / 'truth.npz')


def stamp_ns(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_topics_and_stamps(bag, content, truth):
    assert sorted(path.name for path in bag.iterdir()) == FILES
    counts = {topic: len(messages) for topic, messages in content.items()}
    each = dict.fromkeys(('image/compressed', 'camera_info', 'ground_truth'), 4)
    assert counts == {'body': 1, 'tf_static': 1, **each}
    for topic in ('image/compressed', 'camera_info', 'ground_truth'):
        assert [stamp_ns(message) for message in content[topic]] == list(truth['stamps'])
        assert {message.header.frame_id for message in content[topic]} == {'camera_optical_frame'}
    assert list(np.diff(truth['stamps'])) == [200_000_000] * 3
    assert stamp_ns(content['body'][0]) == truth['stamps'][0]


def test_depth_is_what_a_sensor_measures(tmp_path, content):
    options = [*SMALL, '--seed', '3', '--stature', '1.8', '--depth']
    found = []
    for name in ('once', 'again'):
        assert main(['reach', '-o', str(tmp_path / name), *options]) == 0
        messages = {}
        with BagReader(tmp_path / name) as reader:
            for message in reader.messages():
                messages.setdefault(message.topic.lstrip('/'), []).append(message.message)
        found.append(messages)
    once, again = found
    assert set(once) - set(content) == {'depth'}
    for one, other in zip(once['image/compressed'], content['image/compressed']):
        assert np.array_equal(one.data, other.data)
    for one, other in zip(once['depth'], again['depth']):
        assert np.array_equal(one.data, other.data)
    truth = np.load(tmp_path / 'once' / 'truth.npz')
    masks = np.unpackbits(truth['masks'], axis=2)[:, :, :160].astype(bool)
    pelvis = truth['joints'][:, list(truth['joint_names']).index('pelvis'), 2]
    assert len(once['depth']) == len(pelvis)
    for message, mask, distance in zip(once['depth'], masks, pelvis):
        assert message.encoding == '16UC1'
        depth = decode_depth(message)
        assert np.median(depth[mask & (depth > 0)]) == pytest.approx(distance, abs=0.3)
        assert 0.5 < (depth[mask] > 0).mean() < 1.0
        assert (depth[~mask] > distance + 0.5).any()


def test_the_place_of_the_camera_is_told_as_a_robot_does(content, truth):
    """The transform agrees with gravity and height in the truth."""
    buffer = TransformBuffer()
    assert buffer.put(content['tf_static'][0], static=True) == []
    place = buffer.lookup('odom', 'camera_optical_frame', 0)
    view = Viewpoint()
    np.testing.assert_allclose(place.translation, view.to_world(np.zeros(3)), atol=1e-9)
    np.testing.assert_allclose(place.rotation, view.rotation.T, atol=1e-9)
    np.testing.assert_allclose(truth['gravity'], [[0.0, 1.0, 0.0]] * 4, atol=1e-12)
    assert truth['camera_height'].tolist() == [1.2] * 4


def test_ground_truth_is_the_known_pose(content, truth):
    body = load_body('human37').with_stature(1.8)
    joints = body.joint_positions(truth['poses'])
    assert np.allclose(joints, truth['joints'])
    for frame, message in enumerate(content['ground_truth']):
        assert message.kind == message.GROUND_TRUTH == 4
        assert message.body_model == 'human37'
        assert tuple(message.dof_names) == body.dof_names
        assert tuple(message.joint_names) == body.joint_names
        (component,) = message.components
        assert component.weight == 1.0
        assert component.covariance.shape == (0,)
        assert np.isnan(component.log_likelihood)
        assert np.array_equal(component.mean, truth['poses'][frame])
        points = np.array([[p.x, p.y, p.z] for p in component.joint_positions])
        assert np.allclose(points, joints[frame])


def test_subject_is_what_one_would_click(bag, truth):
    body = load_body('human37').with_stature(1.8)
    subject = read_subject(bag / 'subject.yaml', body)
    assert subject.stamp_ns == truth['stamps'][0]
    names = subject.keypoints.names
    assert names == body.joint_names
    error = subject.keypoints.pixels - truth['pixels'][0]
    assert 1.0 < error.std() < 3.0
    for name, length in subject.segment_lengths.items():
        assert abs(length - body.segment_lengths[name]) <= 0.0025 + 1e-9
        assert np.isclose(length / 0.005, round(length / 0.005))
    assert len(subject.segment_lengths) == 10


def test_same_command_same_bytes(bag, tmp_path):
    again = tmp_path / 'small'
    assert main(['reach', '-o', str(again), *SMALL, '--seed', '3', '--stature', '1.8']) == 0
    assert written(again) == written(bag)
    command = ['reach', '-o', str(again), *SMALL, '--seed', '4', '--stature', '1.8']
    assert main([*command, '--overwrite']) == 0
    changed = written(again)
    assert sorted(changed) == FILES
    assert changed['truth.npz'] != written(bag)['truth.npz']
    assert [path.name for path in tmp_path.iterdir()] == ['small']


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['swim'], "no motion 'swim'"),
        (['walk', '--fps', '0'], '--fps: wanted a number from 0.01 to 1000'),
        (['walk', '--size', '640'], '--size: wanted a size such as 640x480'),
        (['walk', '--size', '640x1'], '--size: wanted sides of 8'),
        (['walk', '--seed', '-1'], '--seed: wanted a whole number'),
        (['walk', '--jpeg-quality', '101'], '--jpeg-quality: wanted a whole number from 1 to 100'),
        (['walk', '--body', 'nobody'], "no body 'nobody'"),
        (['walk', '--speed', '3'], 'unrecognized arguments: --speed'),
        (['walk', '--duration', '0.01'], 'one frame at least'),
        (['any', '--mocap', 'nothing.bvh'], 'nothing.bvh'),
        (['any', '--mocap', 'nothing.bvh', '--stature', '1.7'], '--stature does not go with'),
        (['crossing', '--depth'], '--depth does not go with crossing'),
        (['walk', '--start', '1'], '--start goes with --mocap only'),
        (['reach', '--camera-height', '50'], 'joints of the person, wanted 4'),
    ],
)
def test_bad_input_is_one_line(arguments, message, tmp_path, capsys):
    name, *options = arguments
    assert main([name, '-o', str(tmp_path / 'bag'), *SMALL, *options]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith('make-bag: ')
    assert message in lines[0]
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(
    not (SHARED / 'mocap' / 'dev').is_dir(), reason=f'no motion capture in {SHARED}/mocap/dev'
)
@pytest.mark.parametrize('file', ['cmu_06_01_walk.bvh', 'cmu_93_charleston1.amc'])
def test_recorded_motion(file, tmp_path):
    source = SHARED / 'mocap' / 'dev' / file
    folder = tmp_path / 'recorded'
    options = ['--mocap', str(source), '--start', '0.5', '--heading', '45', '--distance', '7']
    assert main(['any', '-o', str(folder), *SMALL, *options]) == 0
    truth = np.load(folder / 'truth.npz')
    assert str(truth['source']) == file
    assert len(truth['stamps']) in (4, 5)
    assert abs(float(truth['fps']) - 5.0) < 0.3
    names = list(truth['joint_names'])
    world = Viewpoint(distance=7.0).to_world(truth['joints'])
    across = world[0, names.index('right_hip')] - world[0, names.index('left_hip')]
    assert abs(np.degrees(np.arctan2(across[1], across[0])) - 45) < 8
    feet = world[:, [names.index(f'{side}_toe') for side in ('left', 'right')], 2]
    assert 0.0 < feet.min() < 0.08
    assert world[:, names.index('head'), 2].min() > 1.2
    assert np.abs(world[..., :2]).max() < 3.0


def test_bags_of_the_repository(tmp_path, content):
    """The bags in bags/ are reproduced by the commands in its README."""
    readme = (ROOT / 'bags' / 'README.md').read_text()
    lines = [line.split() for line in readme.splitlines() if 'hmt_learning make-bag' in line]
    rendered = [line.split()[-1] for line in readme.splitlines() if 'demonstration.sh' in line]
    assert sorted([line[line.index('-o') + 1] for line in lines] + rendered) == sorted(
        f'bags/{folder.name}' for folder in (ROOT / 'bags').iterdir() if folder.is_dir()
    )
    for name in rendered:
        assert sum(path.stat().st_size for path in (ROOT / name).iterdir()) < 3_000_000
    for line in lines:
        arguments = line[line.index('make-bag') + 1 :]
        kept = ROOT / arguments[arguments.index('-o') + 1]
        made = tmp_path / kept.name
        arguments[arguments.index('-o') + 1] = str(made)
        assert main([*arguments, '--quiet']) == 0
        assert sum(path.stat().st_size for path in kept.iterdir()) < 2_000_000
        assert (made / 'subject.yaml').read_text() == (kept / 'subject.yaml').read_text()
        new, old = np.load(made / 'truth.npz'), np.load(kept / 'truth.npz')
        assert sorted(new) == sorted(old)
        for name in ('stamps', 'joint_names', 'dof_names', 'fps', 'source'):
            assert np.array_equal(new[name], old[name])
        for name in ('poses', 'joints', 'pixels', 'K'):
            assert np.allclose(new[name], old[name], atol=1e-5)
        # Other versions of numpy and OpenCV may round differently.
        assert np.mean(new['masks'] != old['masks']) < 1e-4
        pictures = []
        for folder in (made, kept):
            with BagReader(folder) as reader:
                assert set(reader.topics) == {f'/{topic}' for topic in content}
                pictures.append(
                    [decode_image(m.message) for m in reader.messages(['image/compressed'])]
                )
        for one, other in zip(*pictures, strict=True):
            assert cv2.absdiff(one, other).mean() < 1.0
