"""`lift`: from files of detectors to a bag of mixtures and a report."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml

from hmt_learning.training.training_set import procedural_sequence
from hmt_ros.app import lift
from hmt_ros.app.export import read_tracked_motion
from hmt_ros.body import Camera, load_body
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.inference import GaussianMixture
from msg_tools import BagReader
from msg_tools.messages.headers import START_NS
from msg_tools.messages.pose_mixtures import pose_mixture_of

BODY = load_body('human37')
CAMERA = Camera(554.256, 554.256, 319.5, 239.5, 640, 480)
SCHEME = schemes()['coco17']


def seen(count=6):
    """Keypoints (T, 17, 2) and confidences (T, 17) of somebody who walks, without eyes and ears."""
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
    """The keypoints of a camera that hangs, whose centre is that of the image."""
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
    # The reading of an accelerometer is told, and used the other way round.
    assert joints[2] == pytest.approx(joints[0])
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith('lift: the gravity that is given points to the head of the person')
    assert line.endswith('the opposite is used, [0.00, 1.00, 0.00]')


@pytest.mark.parametrize('gravity', [('1', '0', '0'), ('0', '0', '9.81')])
def test_gravity_of_another_frame_is_told(tmp_path, capsys, gravity):
    path = arrays(tmp_path / 'walk.npz')
    arguments = [str(path), '-o', str(tmp_path / 'out'), *USUAL, '--gravity', *gravity]
    assert lift.main(arguments) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert 'degrees by the gravity that is given: somebody who lies, or --gravity is not in' in line


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


def test_a_subject_file_tells_the_lengths(tmp_path):
    pixels, _ = seen()
    names = {SCHEME.landmarks[i].joint: pixels[0, i] for i in range(5, 17)}
    content = {
        'stamp_ns': 0, 'sigma_px': 2.0, 'stature_m': 1.9,
        'keypoints': {name: [float(x) for x in place] for name, place in names.items()},
    }  # fmt: skip
    subject = tmp_path / 'subject.yaml'
    subject.write_text(yaml.safe_dump(content))
    path, out = arrays(tmp_path / 'walk.npz'), tmp_path / 'out'
    assert lift.main([str(path), '-o', str(out), *USUAL, '--subject', str(subject)]) == 0
    lengths = mixtures(out)[0].segment_lengths
    assert lengths['thigh'] > 1.05 * BODY.segment_lengths['thigh']


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


def test_hours_without_anybody_begin_another_track(tmp_path, capsys):
    pixels, sure = seen()
    names = SCHEME.names
    head = ','.join(f'{name}_{x}' for name in names for x in ('u', 'v', 'confidence'))
    rows = [f'time_s,{head}']
    for t, time in enumerate((0.0, 0.1, 60.0, 10_860.0, 10_860.1, 10_860.2)):
        cells = np.concatenate([pixels[t], sure[t, :, None]], axis=1).ravel()
        rows.append(','.join(f'{x:.6g}' for x in (time, *cells)))
    path, out = tmp_path / 'walk.csv', tmp_path / 'out'
    path.write_text('\n'.join(rows), 'utf-8')
    assert lift.main([str(path), '-o', str(out), *USUAL]) == 0
    assert [one.track_id for one in mixtures(out)] == [1, 1, 1, 2, 2, 2]
    motion = read_tracked_motion(out / 'lifted', track=2)
    assert np.allclose(motion.times, [0.0, 0.1, 0.2])


def test_too_few_landmarks_are_told(tmp_path, capsys):
    sure = np.zeros((6, 17))
    sure[:, 5:8] = 1.0
    path = arrays(tmp_path / 'walk.npz', visibility=sure)
    assert lift.main([str(path), '-o', str(tmp_path / 'out'), *USUAL]) == 1
    assert 'five landmarks' in capsys.readouterr().err
    assert lift.main([str(tmp_path / 'no.npz'), '-o', str(tmp_path / 'out'), *USUAL]) == 1


def test_a_distance_that_leaps_is_told_and_not_trusted(capsys):
    """One image in ten has the person ten times as far away."""
    body = load_body('human37')
    mean = body.prior_mean.copy()
    mean[:3] = 0.3, 0.0, 3.0
    covariance = 1e-3 * np.eye(body.dimension)[None]
    mixtures = []
    for i in range(20):
        place = mean.copy()
        place[:3] *= 10.0 if i % 10 == 4 else 1.0
        mixtures.append(GaussianMixture(np.ones(1), place[None], covariance))
    mixtures[7] = None
    stamps = [i * 33_000_000 for i in range(20)]
    found = lift._with_leaps(mixtures, stamps)
    assert found[7] is None
    assert [found[i] is mixtures[i] for i in range(20)] == [i % 10 != 4 for i in range(20)]
    # The usual distance is one deviation away along the ray, and nothing else changed.
    wide = found[4].covariances[0] - covariance[0]
    assert wide[:3, :3] == pytest.approx(np.outer(9.0 * mean[:3], 9.0 * mean[:3]))
    assert not wide[3:].any()
    assert 'the distance leaps in 2 of 19 images, up to 10.0 times' in capsys.readouterr().err
    assert lift._with_leaps([None] * 3, stamps[:3]) == [None] * 3
    assert capsys.readouterr().err == ''
