"""The command report: what stands in its page, and what the page does in a browser."""

import base64
import html
import json
import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from hmt_ros.app import report
from hmt_ros.app.bag_scores import score_bag
from hmt_ros.app.film_strip import ImageSource, film_strip
from hmt_ros.app.pictures import BONES
from hmt_ros.app.recorded_mixtures import ENDS, KEPT_TRAJECTORIES, read_mixtures
from hmt_ros.app.rendered_bag import FRAME_ID, START_NS, ground_truth
from hmt_ros.app.report_page import data_size
from hmt_ros.app.truth import read_truth
from hmt_ros.body import Camera, load_body
from hmt_ros.inference import GaussianMixture
from msg_tools import BagReader, BagWriter, RosbagsMessages
from msg_tools.bodies import message_of_body
from msg_tools.camera_info import camera_info_message
from msg_tools.images import compressed_image_message
from msg_tools.pose_mixtures import MixtureKind, PoseMixture, pose_mixture_message, pose_mixture_of
from msg_tools.trajectory_mixtures import TrajectoryMixture, trajectory_mixture_message

MESSAGES = RosbagsMessages()
FRAMES, WINDOW, TRAJECTORIES = 7, 3, 10
STAMPS = [START_NS + i * 100_000_000 for i in range(FRAMES)]
CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
PICTURES = ('overview.png', 'overlays.png', 'side_views.png', 'weights.png')


@dataclass(frozen=True)
class Made:
    """A bag of made-up mixtures, the bag of its images, and the truth."""

    out: Path
    images: Path
    truth: Path


@pytest.fixture(scope='module')
def body():
    return load_body('human37').with_stature(1.75)


@pytest.fixture(scope='module')
def poses(body):
    """True poses (T, d): an arm that is raised."""
    poses = np.tile(np.clip(np.zeros(body.dimension), body.lower, body.upper), (FRAMES, 1))
    poses[:, 2] = 4.0
    bends = [i for i, name in enumerate(body.dof_names) if 'left_shoulder' in name]
    poses[:, bends] += 0.1 * np.arange(FRAMES)[:, None]
    return np.clip(poses, body.lower, body.upper)


def mixture_of(body, pose, modes, rng):
    weights = np.sort(rng.dirichlet(np.ones(modes)))[::-1]
    means = pose + 0.1 * rng.normal(size=(modes, body.dimension))
    return GaussianMixture(weights, means, np.tile(0.003 * np.eye(body.dimension), (modes, 1, 1)))


def pose_message(body, mixture, stamp, kind, **fields):
    content = PoseMixture(
        mixture, body.name, body.dof_names, body.joint_names, body.joint_positions(mixture.means),
        kind, stamp, FRAME_ID,
    )  # fmt: skip
    message = pose_mixture_message(MESSAGES, content)
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def window_message(body, poses, last, rng):
    first = max(0, last - WINDOW + 1)
    means = poses[first : last + 1] + 0.1 * rng.normal(
        size=(TRAJECTORIES, last + 1 - first, body.dimension)
    )
    content = TrajectoryMixture(
        weights=rng.dirichlet(np.ones(TRAJECTORIES)),
        means=means,
        marginal_covariances=None,
        log_joint=np.zeros(TRAJECTORIES),
        inflation=np.ones(TRAJECTORIES),
        stamps_ns=tuple(STAMPS[first : last + 1]),
        final_until_ns=STAMPS[0],
        free_energy=np.linspace(9.0 + last, 3.0, 5),
        body_model=body.name,
        dof_names=body.dof_names,
        frame_id=FRAME_ID,
    )
    return trajectory_mixture_message(MESSAGES, content)


def write_out(path, body, poses, *, truth=True, overlay=False, change=None):
    rng = np.random.default_rng(0)
    with BagWriter(path) as bag:
        bag.write('body', START_NS, message_of_body(MESSAGES, body, START_NS, FRAME_ID))
        for i, stamp in enumerate(STAMPS):
            for topic, kind, modes in (
                ('pose_mixture', MixtureKind.POSTERIOR, 3 + i % 2),
                ('smoothed_pose_mixture', MixtureKind.SMOOTHED, 2),
            ):
                message = pose_message(body, mixture_of(body, poses[i], modes, rng), stamp, kind)
                bag.write(topic, stamp, message if change is None else change(message))
            bag.write('trajectory_mixture', stamp, window_message(body, poses, i, rng))
            if overlay:
                picture = np.full((240, 320, 3), 90, np.uint8)
                message = compressed_image_message(MESSAGES, picture, stamp, FRAME_ID)
                bag.write('overlay/compressed', stamp, message)
            if truth:
                joints = body.joint_positions(poses[i : i + 1])[0]
                message = ground_truth(MESSAGES, body, poses[i], joints, stamp)
                bag.write('ground_truth', stamp, message)
    return path


def write_images(path, stamps=STAMPS, picture=None):
    if picture is None:
        picture = np.full((240, 320, 3), 120, np.uint8)
        picture[:, ::16] = 60
    with BagWriter(path) as bag:
        large = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
        camera = CAMERA if picture.shape[1] == CAMERA.width else large
        message = camera_info_message(MESSAGES, camera, stamps[0], FRAME_ID)
        bag.write('camera_info', stamps[0], message)
        for stamp in stamps:
            message = compressed_image_message(MESSAGES, picture, stamp, FRAME_ID)
            bag.write('image/compressed', stamp, message)
    return path


@pytest.fixture(scope='module')
def made(tmp_path_factory, body, poses):
    folder = tmp_path_factory.mktemp('bags')
    np.savez(
        folder / 'truth.npz',
        stamps=np.array(STAMPS),
        joint_names=np.array(body.joint_names),
        joints=body.joint_positions(poses),
    )
    return Made(
        write_out(folder / 'out', body, poses, truth=False),
        write_images(folder / 'in'),
        folder / 'truth.npz',
    )


def make(out, folder, *options):
    """The report's page, as text."""
    assert report.main([str(out), '-o', str(folder), '--quiet', *map(str, options)]) == 0
    return (folder / 'report.html').read_text('utf-8')


def data_of(page):
    (text,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    return json.loads(text)


@pytest.fixture(scope='module')
def folder(made, tmp_path_factory):
    folder = tmp_path_factory.mktemp('report') / 'new' / 'report'
    make(made.out, folder, '--images', made.images, '--truth', made.truth)
    return folder


@pytest.fixture(scope='module')
def page(folder):
    return (folder / 'report.html').read_text('utf-8')


@pytest.fixture(scope='module')
def data(page):
    return data_of(page)


def integers(text):
    return np.frombuffer(base64.b64decode(text), '<i2').astype(float)


def positions(data, text, *shape):
    return np.array(data['origin']) + data['step'] * integers(text).reshape(*shape, 3)


# What stands in the page.


@pytest.mark.parametrize('topic', ['pose_mixture', 'smoothed_pose_mixture'])
def test_modes_are_those_of_the_bag(made, data, body, topic):
    (layer,) = (layer for layer in data['layers'] if layer['topic'] == topic)
    with BagReader(made.out) as bag:
        contents = [pose_mixture_of(stored.message) for stored in bag.messages([topic])]
    assert layer['kind'] == contents[0].kind.name.lower()
    assert layer['joints'] == list(body.joint_names)
    assert np.allclose(data['times'], np.arange(FRAMES) / 10)
    for weights, content in zip(layer['weights'], contents, strict=True):
        assert np.allclose(weights, content.mixture.weights, atol=1e-5)
    joints = np.concatenate([content.joint_positions for content in contents])
    assert np.abs(positions(data, layer['positions'], *joints.shape[:2]) - joints).max() < 3e-4
    pixels = integers(layer['pixels']).reshape(*joints.shape[:2], 2) * data['pixel'] * CAMERA.width
    assert np.abs(pixels - CAMERA.project(joints)).max() < CAMERA.width / 8000


def test_bones_connect_the_joints_of_the_pictures(data):
    layer = data['layers'][0]
    named = {(layer['joints'][a], layer['joints'][b]) for a, b, _ in layer['bones']}
    assert named == {(a, b) for a, b, _ in BONES}
    sides = {layer['joints'][b]: side for _, b, side in layer['bones']}
    assert sides['left_wrist'] == 'left'
    assert sides['right_wrist'] == 'right'
    assert sides['neck'] == 'trunk'


def test_trajectories_are_those_of_the_bag(made, data, body):
    (topic,) = data['trajectories']
    assert topic['ends'] == list(ENDS)
    with BagReader(made.out) as bag:
        messages = [stored.message for stored in bag.messages(['trajectory_mixture'])]
    assert len(topic['windows']) == len(messages) == FRAMES
    for window, message in zip(topic['windows'], messages, strict=True):
        assert np.allclose(window['weights'], [c.weight for c in message.components], atol=1e-5)
        assert np.allclose(window['free_energy'], message.free_energy, atol=1e-4)
        steps = len(message.stamps)
        assert len(window['times']) == steps
        means = [c.means.reshape(steps, -1) for c in message.components[:KEPT_TRAJECTORIES]]
        joints = body.joint_positions(np.concatenate(means))
        ways = joints[:, body.skeleton.joint_index(ENDS)]
        found = positions(data, window['ways'], *ways.shape[:2])
        assert np.abs(found - ways).max() < 3e-4


def test_truth_errors_and_calibration(made, data, body, poses):
    truth = body.joint_positions(poses)
    assert data['truth']['known'] == [True] * FRAMES
    found = positions(data, data['truth']['positions'], *truth.shape[:2])
    assert np.abs(found - truth).max() < 3e-4
    scores = score_bag(made.out, read_truth(made.truth))
    for layer in data['layers']:
        own = scores[layer['topic']].scores
        assert np.allclose([e[0] for e in layer['errors_mm']], 1e3 * own.heaviest.mean(1), atol=0.1)
        best = [min(errors) for errors in layer['errors_mm']]
        assert np.allclose(best, 1e3 * own.best.mean(1), atol=0.1)
        told = data['scores']['topics'][layer['topic']]
        assert told['coverage_90'] == own.summary()['coverage_90']
        at_half = data['scores']['probabilities'].index(0.5)
        assert told['calibration']['together'][at_half] == pytest.approx(
            told['coverage_50'], abs=1e-4
        )
    trajectories = data['scores']['topics']['trajectory_mixture']
    assert trajectories['calibration'] == {'together': None, 'each': None}
    assert any(note.startswith('trajectory_mixture') for note in data['notes'])


def test_images_are_those_of_the_bag(data):
    images = data['images']
    assert (images['width'], images['height'], images['drawn_on']) == (320, 240, False)
    assert len(images['jpegs']) == FRAMES
    for jpeg in images['jpegs']:
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(jpeg), np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (240, 320, 3)


def test_pictures_lie_beside_the_page(folder):
    wanted = {'report.html', 'calibration.png', 'free_energy.png', *PICTURES}
    assert {path.name for path in folder.iterdir()} == wanted
    assert [path.name for path in folder.parent.iterdir()] == ['report']
    for name in wanted - {'report.html'}:
        assert min(cv2.imread(str(folder / name)).shape[:2]) > 200, name


def test_the_page_needs_nothing_else(page):
    assert not re.findall(r'https?:|//[a-z]+\.', page)
    assert not re.findall(r'<(?:link|iframe|object|embed|base)\b|\b(?:src|href)\s*=\s*["\']', page)
    assert not re.findall(r'\burl\(|@import|\bfetch\(|XMLHttpRequest|WebSocket|\bimport\(', page)
    assert "default-src 'none'" in page
    assert '<!--' not in page
    assert page.isascii()


def test_the_same_bag_gives_the_same_page(made, page, tmp_path):
    assert page == make(
        made.out, tmp_path / 'again', '--images', made.images, '--truth', made.truth
    )


def test_ground_truth_of_the_bag_is_used(body, poses, data, tmp_path):
    found = data_of(make(write_out(tmp_path / 'out', body, poses), tmp_path / 'report'))
    assert found['truth']['source'].endswith('(ground_truth)')
    assert [layer['topic'] for layer in found['layers']] == [
        'pose_mixture',
        'smoothed_pose_mixture',
    ]
    assert found['truth']['known'] == data['truth']['known']
    assert found['images'] is None


def test_without_images_and_truth(made, tmp_path):
    found = data_of(make(made.out, tmp_path / 'report'))
    assert (found['images'], found['truth'], found['scores']) == (None, None, None)
    assert found['layers'][0]['pixels'] is None
    names = {path.name for path in (tmp_path / 'report').iterdir()}
    assert names == {'report.html', 'side_views.png', 'weights.png', 'free_energy.png'}


def test_images_that_the_bag_has_itself(body, poses, made, tmp_path):
    out = tmp_path / 'out'
    with BagWriter(out) as bag, BagReader(made.images) as images, BagReader(made.out) as mixtures:
        for reader in (images, mixtures):
            for stored in reader.messages():
                bag.write(stored.topic, stored.log_time_ns, stored.message)
        picture = np.zeros((240, 320, 3), np.uint8)
        message = compressed_image_message(MESSAGES, picture, STAMPS[0], FRAME_ID)
        bag.write('overlay/compressed', STAMPS[0], message)
    found = data_of(make(out, tmp_path / 'report'))
    assert found['images']['drawn_on'] is False
    assert len(found['images']['jpegs']) == FRAMES
    assert found['layers'][0]['pixels'] is not None


def test_what_the_tracker_drew_stands_in_for_images(body, poses, tmp_path):
    out = write_out(tmp_path / 'out', body, poses, overlay=True)
    found = data_of(make(out, tmp_path / 'report'))
    assert found['images']['drawn_on'] is True
    assert len(found['images']['jpegs']) == FRAMES
    assert found['layers'][0]['pixels'] is None
    assert not (tmp_path / 'report' / 'overview.png').exists()


def test_chosen_topics_and_fewer_times(made, tmp_path):
    options = ['--topic', 'smoothed_pose_mixture', '--times', '4', '--truth', made.truth]
    found = data_of(make(made.out, tmp_path / 'report', *options))
    assert [layer['topic'] for layer in found['layers']] == ['smoothed_pose_mixture']
    assert found['trajectories'] == []
    assert np.allclose(found['times'], [0.0, 0.2, 0.4, 0.6])
    assert found['scores']['topics']['smoothed_pose_mixture']['frames'] == FRAMES
    assert found['notes'] == [f'4 of {FRAMES} times are shown']


def test_one_window_over_the_whole_time(body, poses, tmp_path):
    """Trajectories that stand alone: their own times are shown."""
    rng = np.random.default_rng(0)
    means = poses + 0.1 * rng.normal(size=(2, *poses.shape))
    content = TrajectoryMixture(
        np.array([0.25, 0.75]), means, None, np.zeros(2), np.ones(2), tuple(STAMPS), STAMPS[-1],
        np.array([2.0, 1.0]), body.name, body.dof_names, FRAME_ID,
    )  # fmt: skip
    for with_body in (True, False):
        with BagWriter(tmp_path / f'out{with_body}') as bag:
            if with_body:
                bag.write('body', START_NS, message_of_body(MESSAGES, body, START_NS, FRAME_ID))
            message = trajectory_mixture_message(MESSAGES, content)
            bag.write('trajectory_mixture', STAMPS[-1], message)
        data = data_of(make(tmp_path / f'out{with_body}', tmp_path / f'report{with_body}'))
        assert np.allclose(data['times'], np.arange(FRAMES) / 10)
        (window,) = data['trajectories'][0]['windows']
        assert window['weights'] == [0.75, 0.25]
        assert (window['ways'] is not None) == with_body
        assert len(data['notes']) == (0 if with_body else 1)


def test_mixtures_without_covariances_and_missing_frames(body, poses, tmp_path):
    def change(message):
        for component in message.components:
            component.covariance = np.empty(0)
        return message

    out = write_out(tmp_path / 'out', body, poses, change=change)
    found = data_of(make(out, tmp_path / 'report'))
    assert found['scores']['topics']['pose_mixture']['calibration']['together'] is None
    assert not (tmp_path / 'report' / 'calibration.png').exists()

    with BagWriter(tmp_path / 'predicted') as bag:
        for i, stamp in enumerate(STAMPS[:3]):
            mixture = GaussianMixture(
                np.ones(1), poses[i : i + 1], 0.01 * np.eye(body.dimension)[None]
            )
            message = pose_message(body, mixture, stamp, MixtureKind.PREDICTION)
            if i == 1:
                message.components = []
            bag.write('pose_prediction', stamp, message)
    found = data_of(make(tmp_path / 'predicted', tmp_path / 'second'))
    assert np.allclose(found['times'], [0.0, 0.2])


def test_text_from_outside_stays_text(body, poses, made, tmp_path):
    def change(message):
        message.joint_names = ['</script><b>' if n == 'head' else n for n in message.joint_names]
        return message

    out = write_out(tmp_path / '<img src=x>', body, poses, change=change, truth=False)
    page = make(out, tmp_path / 'report')
    assert page.count('</script>') == 2
    assert '<img' not in page
    assert '&lt;img src=x&gt;' in page
    assert '</script><b>' in data_of(page)['layers'][0]['joints']


# How large it gets.


def noise(width, height):
    return np.random.default_rng(0).integers(0, 255, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize('each', [60_000, 6_000, 1_500])
def test_images_get_smaller_until_they_fit(each, tmp_path):
    path = write_images(tmp_path / 'in', picture=noise(640, 480))
    source = ImageSource(path, 'image/compressed', 'camera_info')
    strip = film_strip(source, STAMPS, each * FRAMES, keep={STAMPS[2]})
    assert sum(len(jpeg) for jpeg in strip.jpegs.values()) <= each * FRAMES
    assert strip.size == (640, 480)
    assert strip.kept[STAMPS[2]].shape == (480, 640, 3)
    # Where even the smallest are too large, some are left out.
    assert (len(strip.jpegs) == FRAMES) == (each > 1_500)


def test_two_hundred_frames_stay_under_20_mb(body, poses, tmp_path):
    stamps = [START_NS + i * 33_333_333 for i in range(200)]
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / 'out') as bag:
        mixture = mixture_of(body, poses[0], 16, rng)
        for stamp in stamps:
            for topic in ('pose_mixture', 'likelihood_mixture', 'smoothed_pose_mixture'):
                message = pose_message(body, mixture, stamp, MixtureKind.POSTERIOR)
                bag.write(topic, stamp, message)
    # Nothing compresses worse than noise: 0.2 MB an image.
    images = write_images(tmp_path / 'in', stamps, noise(640, 480))
    page = make(tmp_path / 'out', tmp_path / 'report', '--images', images)
    data = data_of(page)
    assert len(data['times']) == 200
    assert None not in data['images']['jpegs']
    assert 10_000_000 < len(page) < 20_000_000
    mixtures = read_mixtures(tmp_path / 'out')
    told = sum(len(layer['positions']) + len(layer['pixels']) for layer in data['layers'])
    assert told < data_size(mixtures) < 1.2 * told


def test_times_are_left_out_where_the_data_get_too_large(made, tmp_path, monkeypatch):
    size = data_size(read_mixtures(made.out))
    monkeypatch.setattr(report, 'DATA_BYTES', size // 2)
    data = data_of(make(made.out, tmp_path / 'report'))
    assert len(data['times']) == 3


# What goes wrong.


def fails(tmp_path, capsys, out, *options):
    """The line that the command ends with; nothing may be written."""
    target = tmp_path / 'new' / 'report'
    assert report.main([str(out), '-o', str(target), *map(str, options)]) == 1
    captured = capsys.readouterr()
    assert captured.out == ''
    (line,) = captured.err.splitlines()
    assert line.startswith('report: ')
    assert not target.parent.exists()
    return line


def test_bags_that_can_not_be_shown(made, tmp_path, capsys):
    assert 'can not be read' in fails(tmp_path, capsys, tmp_path / 'nowhere')
    assert 'has no pose mixtures' in fails(tmp_path, capsys, made.images)
    line = fails(tmp_path, capsys, made.out, '--topic', 'body')
    assert 'has no mixtures' in line
    content = (made.out / 'out.mcap').read_bytes()
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(content[: len(content) // 2])
    assert str(cut) in fails(tmp_path, capsys, cut)
    cut.write_bytes(b'')
    assert str(cut) in fails(tmp_path, capsys, cut)
    line = fails(tmp_path, capsys, made.out, '--images', made.out)
    assert 'no topic of type' in line


def test_mixtures_that_can_not_be_understood(body, poses, tmp_path, capsys):
    def heavy(message):
        message.components[0].weight = 2.0
        return message

    out = write_out(tmp_path / 'heavy', body, poses, change=heavy, truth=False)
    assert 'weights that sum to' in fails(tmp_path, capsys, out)

    def elsewhere(message):
        message.header.frame_id = f'camera_{int(message.kind)}'
        return message

    out = write_out(tmp_path / 'elsewhere', body, poses, change=elsewhere, truth=False)
    assert 'name those of one camera by --topic' in fails(tmp_path, capsys, out)


def test_truth_that_does_not_fit(made, body, poses, tmp_path, capsys):
    joints = body.joint_positions(poses)
    later = tmp_path / 'later.npz'
    np.savez(
        later, stamps=np.array(STAMPS) + 1, joint_names=np.array(body.joint_names), joints=joints
    )
    assert 'is among those of' in fails(tmp_path, capsys, made.out, '--truth', later)
    fewer = tmp_path / 'fewer.npz'
    np.savez(fewer, stamps=np.array(STAMPS), joint_names=np.array(['pelvis']), joints=joints)
    assert 'wanted (1, 3)' in fails(tmp_path, capsys, made.out, '--truth', fewer)
    line = fails(tmp_path, capsys, made.out, '--truth', tmp_path / 'none.npz')
    assert 'can not be read' in line
    assert 'has no ground truth' in fails(tmp_path, capsys, made.out, '--truth', made.images)


def test_images_that_do_not_fit(made, tmp_path, capsys):
    other = write_images(tmp_path / 'other', [stamp + 1 for stamp in STAMPS])
    line = fails(tmp_path, capsys, made.out, '--images', other)
    assert 'is it the bag that was tracked?' in line
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes((made.images / 'in.mcap').read_bytes()[:-200])
    assert str(cut) in fails(tmp_path, capsys, made.out, '--images', cut)


def test_only_reports_are_replaced(made, page, tmp_path, capsys):
    folder = tmp_path / 'report'
    folder.mkdir()
    (folder / 'letter.txt').write_text('dear')
    for options in ([], ['--overwrite']):
        assert report.main([str(made.out), '-o', str(folder), *options]) == 1
        assert str(folder) in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ['report']
    (folder / 'letter.txt').unlink()
    (folder / 'report.html').write_text('an older one')
    assert report.main([str(made.out), '-o', str(folder)]) == 1
    assert 'exists' in capsys.readouterr().err
    make(made.out, folder, '--overwrite', '--images', made.images, '--truth', made.truth)
    assert (folder / 'report.html').read_text('utf-8') == page


@pytest.mark.parametrize(('error', 'code'), [(KeyboardInterrupt(), 130), (OSError(28, 'full'), 1)])
def test_after_an_error_nothing_is_left(made, error, code, tmp_path, monkeypatch, capsys):
    def fail(*_):
        raise error

    folder = tmp_path / 'report'
    folder.mkdir()
    (folder / 'report.html').write_text('an older one')
    monkeypatch.setattr(report, 'draw_pictures', fail)
    assert report.main([str(made.out), '-o', str(folder), '--overwrite']) == code
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ['report']
    assert [path.read_text() for path in folder.iterdir()] == ['an older one']


def test_it_tells_what_came_out(made, tmp_path, capsys):
    assert report.main([str(made.out), '-o', str(tmp_path / 'report')]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f'{tmp_path / "report" / "report.html"}: {FRAMES} times, ')
    assert any('weights.png' in line for line in lines)


# In a browser.

BROWSERS = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome')
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
in_a_browser = pytest.mark.skipif(
    BROWSER is None, reason=f'no Chromium is installed: looked for {", ".join(BROWSERS)}'
)

# Before anything else in the page: what it complains about.
COMPLAINTS = """<script>
const complaints = [];
const complain = (...words) => complaints.push(words.join(' '));
['error', 'warn'].forEach((kind) => { console[kind] = complain; });
['error', 'unhandledrejection', 'securitypolicyviolation'].forEach((kind) => addEventListener(
  kind, (event) => complain(kind, event.message || event.reason || event.blockedURI), true,
));
</script>
"""
# After everything else: what a person does, and what is seen then.
VISIT = """<script>
const seen = {};
function look(name, id = 'space') {
  const canvas = document.getElementById(id);
  const { width, height } = canvas;
  // A copy: reading a canvas often would change how it is kept.
  const copy = new OffscreenCanvas(width, height);
  const context = copy.getContext('2d', { willReadFrequently: true });
  context.drawImage(canvas, 0, 0);
  const pixels = context.getImageData(0, 0, width, height).data;
  let hash = 0;
  let drawn = 0;
  for (let i = 0; i < pixels.length; i += 4) {
    for (let c = 0; c < 4; c += 1) hash = (Math.imul(hash, 31) + pixels[i + c]) | 0;
    if (pixels[i + 3]) drawn += 1;
  }
  seen[name] = `${hash}`;
  seen[`${name} drawn`] = drawn;
}
const get = (id) => document.getElementById(id);
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
function pointer(target, kind, x, y) {
  target.dispatchEvent(new PointerEvent(kind, { clientX: x, clientY: y, bubbles: true }));
}
function key(target, name) {
  const options = { key: name, bubbles: true, cancelable: true };
  target.dispatchEvent(new KeyboardEvent('keydown', options));
}
async function visit() {
  await pause(300);
STEPS
}
visit().catch((error) => complaints.push(`visit: ${error}`)).finally(() => {
  const result = document.createElement('pre');
  result.id = 'seen';
  result.textContent = JSON.stringify({ ...seen, complaints });
  document.body.append(result);
});
</script>
"""


def visit(page, steps, folder, fragment=''):
    """What a browser sees that opens the page from its file and takes some steps."""
    path = folder / 'visited.html'
    path.write_text(
        page.replace('<head>\n', f'<head>\n{COMPLAINTS}', 1).replace(
            '</body>', f'{VISIT.replace("STEPS", steps)}</body>', 1
        ),
        'utf-8',
    )
    result = subprocess.run(
        [
            BROWSER, '--headless', '--no-sandbox', '--disable-gpu', '--disable-dev-shm-usage',
            '--no-first-run', '--disable-extensions', '--disable-background-networking',
            '--host-resolver-rules=MAP * ~NOTFOUND', f'--user-data-dir={folder / "profile"}',
            '--enable-logging=stderr', '--window-size=1200,900', '--virtual-time-budget=20000',
            '--dump-dom', f'{path.as_uri()}{fragment}',
        ],
        capture_output=True, text=True, timeout=300, check=False,
        env={**os.environ, 'HOME': str(folder)},
    )  # fmt: skip
    found = re.findall(r'<pre id="seen">(.*?)</pre>', result.stdout, re.S)
    assert found, f'{result.stderr[-2000:]} {result.stdout[-500:]}'
    seen = json.loads(html.unescape(found[0]))
    assert seen.pop('complaints') == []
    assert 'CONSOLE' not in result.stderr
    return seen


@in_a_browser
def test_slider_mouse_and_keys_change_the_view(page, tmp_path):
    seen = visit(
        page,
        """
        look('first'); look('first image', 'image'); look('first weights', 'weights');
        get('time').value = 5; get('time').dispatchEvent(new Event('input', { bubbles: true }));
        await pause(300);
        look('later'); look('later image', 'image'); look('later weights', 'weights');
        seen.clock = get('clock').value; seen.spoken = get('time').getAttribute('aria-valuetext');
        const space = get('space');
        const place = space.getBoundingClientRect();
        pointer(space, 'pointerdown', place.left + 100, place.top + 100);
        pointer(space, 'pointermove', place.left + 220, place.top + 110);
        look('dragged');
        pointer(space, 'pointerup', place.left + 220, place.top + 110);
        pointer(space, 'pointermove', place.left + 20, place.top + 10);
        look('let go');
        key(space, 'ArrowLeft'); look('key');
        space.dispatchEvent(new WheelEvent('wheel', { deltaY: -300, cancelable: true }));
        look('wheel');
        document.querySelector('[data-look="0 0"]').click(); look('from the camera');
        key(space, '0'); look('reset');
        key(document.body, 'ArrowLeft'); seen['clock after a key'] = get('clock').value;
        """,
        tmp_path,
    )
    views = ['first', 'later', 'dragged', 'key', 'wheel', 'from the camera']
    assert len({seen[name] for name in views}) == len(views)
    assert min(seen[f'{name} drawn'] for name in views) > 1000
    assert seen['let go'] == seen['dragged']
    assert seen['reset'] == seen['later']
    assert seen['first image'] != seen['later image']
    assert seen['first image drawn'] > 100_000
    assert seen['first weights'] != seen['later weights']
    assert seen['clock'] == seen['spoken'] == f'0.50 s, 6 of {FRAMES}'
    assert seen['clock after a key'] == f'0.40 s, 5 of {FRAMES}'


@in_a_browser
def test_layers_modes_and_play(page, tmp_path):
    seen = visit(
        page,
        """
        look('first');
        get('layer-1').click(); look('both'); get('layer-1').click(); look('again');
        get('show-truth').click(); look('without truth'); get('show-truth').click();
        get('show-trajectories').click(); look('ways'); get('show-trajectories').click();
        get('align').click(); look('aligned'); get('align').click();
        look('image with', 'image'); get('with-modes').click(); look('image without', 'image');
        seen.rows = document.querySelectorAll('#modes tbody tr').length;
        document.querySelector('#modes button').click(); look('alone');
        document.querySelector('#modes button').click(); look('all');
        get('chosen').value = 2; get('chosen').dispatchEvent(new Event('change'));
        seen.trajectories = document.querySelectorAll('#modes tbody tr').length;
        seen.errors = get('errors-figure').hidden;
        get('play').click(); seen.playing = get('play').getAttribute('aria-pressed');
        for (let i = 0; i < 100 && Number(get('time').value) < 2; i += 1) await pause(50);
        get('play').click(); seen.time = Number(get('time').value);
        seen.paused = get('play').textContent;
        ['together', 'each', 'free-energy', 'iterations'].forEach((id) => look(id, id));
        seen.scores = document.querySelectorAll('#scores tbody tr').length;
        seen.named = [...document.querySelectorAll('button, input, select, canvas')].every((x) => (
          x.textContent.trim() || x.getAttribute('aria-label') || (x.labels && x.labels.length)
        ));
        seen.title = get('title').textContent;
        """,
        tmp_path,
    )
    views = ['first', 'both', 'without truth', 'ways', 'aligned', 'alone']
    assert len({seen[name] for name in views}) == len(views)
    assert seen['again'] == seen['all'] == seen['first']
    assert seen['image with'] != seen['image without']
    assert seen['rows'] == 3
    assert seen['trajectories'] == TRAJECTORIES
    assert seen['errors'] is True
    assert seen['playing'] == 'true'
    assert 2 <= seen['time'] < FRAMES
    assert seen['paused'] == 'Play'
    assert (
        min(seen[f'{name} drawn'] for name in ('together', 'each', 'free-energy', 'iterations'))
        > 500
    )
    assert seen['scores'] == 3
    assert seen['named'] is True
    assert seen['title'] == 'out: mixtures over poses'


@in_a_browser
def test_pages_with_less_in_them(made, body, poses, tmp_path):
    bare = make(made.out, tmp_path / 'bare', '--topic', 'pose_mixture')
    steps = "look('space'); seen.image = get('image-figure').hidden; look('weights', 'weights');"
    seen = visit(bare, steps, tmp_path)
    assert seen['image'] is True
    assert min(seen['space drawn'], seen['weights drawn']) > 1000

    ways = make(made.out, tmp_path / 'ways', '--topic', 'trajectory_mixture')
    seen = visit(
        ways,
        "look('space'); get('time').value = 3; get('time').dispatchEvent(new Event('input'));"
        "look('later');",
        tmp_path,
    )
    assert seen['space drawn'] > 1000
    assert seen['space'] != seen['later']

    single = make(
        made.out,
        tmp_path / 'single',
        '--times',
        '1',
        '--images',
        made.images,
        '--truth',
        made.truth,
    )
    seen = visit(single, "look('space'); get('play').click(); await pause(200);", tmp_path)
    assert seen['space drawn'] > 1000


@in_a_browser
def test_the_address_tells_what_is_shown(page, tmp_path):
    steps = "look('space'); seen.clock = get('clock').value; seen.second = get('layer-1').checked;"
    plain = visit(page, steps, tmp_path)
    given = visit(page, steps, tmp_path, '#frame=4&yaw=90&pitch=10&show=0,1')
    assert given['clock'] == f'0.40 s, 5 of {FRAMES}'
    assert (plain['second'], given['second']) == (False, True)
    assert given['space'] != plain['space']
