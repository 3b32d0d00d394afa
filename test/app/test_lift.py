"""`lift`: from detector files to a bag of mixtures and a report."""

from __future__ import annotations

import json

import numpy as np
import pytest

from hmt_learning.training.training_set import procedural_sequence
from hmt_ros.app import lift
from hmt_ros.body import Camera, load_body
from hmt_ros.image.keypoint_schemes import schemes
from msg_tools import BagReader
from msg_tools.messages.headers import START_NS
from msg_tools.messages.pose_mixtures import pose_mixture_of

BODY = load_body('human37')
CAMERA = Camera(554.256, 554.256, 319.5, 239.5, 640, 480)
SCHEME = schemes()['coco17']


def seen(count=6):
    """Keypoints (T, 17, 2) and confidences (T, 17) of a walking person, without eyes and ears."""
    poses = procedural_sequence('walk', BODY, 1.0, 0).poses[:count].copy()
    poses[:, :3] += np.array([0.0, 0.0, 4.0]) - poses[0, :3]
    pixels = CAMERA.project(BODY.joint_positions(poses).reshape(-1, 3)).reshape(count, -1, 2)
    result, sure = np.zeros((count, 17, 2)), np.zeros((count, 17))
    for i, mark in enumerate(SCHEME.landmarks):
        if mark.joint and 'ear' not in mark.name:
            result[:, i] = pixels[:, BODY.joint_names.index(mark.joint)]
            sure[:, i] = 1.0
    return result, sure


def arrays(path, **more):
    pixels, sure = seen()
    content = {'landmark_names': np.array(SCHEME.names), 'pixels': pixels, 'visibility': sure}
    np.savez(path, **{**content, **more})
    return path


def mixtures(folder):
    with BagReader(folder / 'lifted') as bag:
        return [
            pose_mixture_of(message.message)
            for message in bag.messages()
            if message.topic.endswith('pose_prediction')
        ]


USUAL = ['--fov', '60', '--size', '640x480', '--quiet']


def test_arrays_become_mixtures_and_a_report(tmp_path):
    path = arrays(tmp_path / 'walk.npz')
    out, again = tmp_path / 'out', tmp_path / 'again'
    for folder in (out, again):
        assert lift.main([str(path), '-o', str(folder), *USUAL, '--fps', '30', '--level']) == 0
    # The same input gives the same bytes.
    first, second = (folder / 'lifted' / 'lifted.mcap' for folder in (out, again))
    assert first.read_bytes() == second.read_bytes()
    found = mixtures(out)
    assert len(found) == 6
    assert found[0].stamp_ns == START_NS
    assert found[1].stamp_ns == START_NS + round(1e9 / 30)
    assert all(one.weights.sum() == pytest.approx(1.0) for one in found)
    assert (out / 'report' / 'report.html').stat().st_size > 50_000
    # Nothing is overwritten unless asked for.
    assert lift.main([str(path), '-o', str(out), *USUAL]) == 1
    assert lift.main([str(path), '-o', str(out), *USUAL, '--overwrite', '--causal']) == 0


def upside_down(path):
    """The keypoints of an upside-down camera with a centred principal point."""
    pixels, sure = seen(12)
    pixels[sure > 0] = 2.0 * np.array([CAMERA.cx, CAMERA.cy]) - pixels[sure > 0]
    np.savez(path, landmark_names=np.array(SCHEME.names), pixels=pixels, visibility=sure)
    return path


def test_a_camera_that_hangs_upside_down(tmp_path, capsys):
    upright, hanging = tmp_path / 'upright.npz', upside_down(tmp_path / 'hanging.npz')
    pixels, sure = seen(12)
    np.savez(upright, landmark_names=np.array(SCHEME.names), pixels=pixels, visibility=sure)
    joints = []
    for path, gravity in ((upright, '1'), (hanging, '-1'), (upright, '-1')):
        out = tmp_path / f'{path.stem}{gravity}'
        arguments = [str(path), '-o', str(out), *USUAL, '--gravity', '0', gravity, '0']
        assert lift.main(arguments) == 0
        joints.append(np.array([one.joint_positions[0] for one in mixtures(out)]))
    assert joints[1] * [-1, -1, 1] == pytest.approx(joints[0], abs=5e-3)
    # An accelerometer reading is detected, and inverted.
    assert joints[2] == pytest.approx(joints[0])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('lift: the given gravity points to the head of the person')
    assert line.endswith('the opposite is used, [0.00, 1.00, 0.00]')


def test_coco_and_stature(tmp_path):
    pixels, sure = seen()
    entries = [
        {
            'image_id': t,
            'keypoints': np.concatenate([pixels[t], sure[t, :, None]], axis=1).ravel().tolist(),
        }
        for t in range(len(pixels))
    ]
    path = tmp_path / 'walk.json'
    path.write_text(json.dumps(entries))
    sizes = {}
    for stature in ('1.5', '1.9'):
        out = tmp_path / stature
        assert lift.main([str(path), '-o', str(out), *USUAL, '--stature', stature]) == 0
        sizes[stature] = mixtures(out)[0].means[0, 2]
    assert sizes['1.9'] / sizes['1.5'] == pytest.approx(1.9 / 1.5, rel=0.05)


@pytest.mark.parametrize(
    ('arguments', 'said'),
    [
        (['--fov', '60'], 'the size of the images is unknown: --size WxH'),
        ([*USUAL, '--lifter', 'none.npz'], 'none.npz'),
        (
            [*USUAL, '--person', 'index:3'],
            'no frame has a person 3: the last is --person index:0',
        ),
        ([*USUAL, '--scheme', 'none'], "there is no keypoint scheme 'none'"),
        (
            [*USUAL, '--gravity', '0', '0', '0'],
            '--gravity must be three finite numbers, not all zero',
        ),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, arguments, said):
    path = arrays(tmp_path / 'walk.npz')
    assert lift.main([str(path), '-o', str(tmp_path / 'out'), *arguments]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert error.count('\n') == 1
    assert not (tmp_path / 'out' / 'lifted').exists()


def test_nobody_in_the_whole_file(tmp_path, capsys):
    path = arrays(tmp_path / 'walk.npz', detected=np.zeros(6, dtype=bool))
    assert lift.main([str(path), '-o', str(tmp_path / 'out'), *USUAL[:-1]]) == 0
    told = capsys.readouterr().out
    assert 'lifted: 6 images, 0 with a pose' in told
    assert 'nobody is found at 6 of 6 times' in told
    assert [len(one.weights) for one in mixtures(tmp_path / 'out')] == [0] * 6
    assert (tmp_path / 'out' / 'report' / 'report.html').stat().st_size > 50_000
