"""The command report: content of its page."""

import base64
import re

import cv2
import numpy as np
import pytest

from hmt_ros.app.evaluate import score_bag
from hmt_ros.app.report import command as report
from hmt_ros.app.report.images import ImageSource, film_strip
from hmt_ros.app.report.mixtures import MAX_TRAJECTORIES, PATH_JOINTS, read_mixtures
from hmt_ros.app.report.page import data_size
from hmt_ros.app.truth import read_truth
from msg_tools import BagReader, BagWriter
from msg_tools.messages.ground import GroundState, ground_message
from msg_tools.messages.headers import FRAME_ID, time_ns
from msg_tools.messages.keep_out import KeepOut, KeepOutState, keep_out_message
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, MixtureKind, pose_mixture_of
from test.app.conftest import (
    CAMERA,
    FRAMES,
    MESSAGES,
    STAMPS,
    data_of,
    make,
    write_images,
    write_out,
)

PICTURES = ('overview.png', 'overlays.png', 'side_views.png', 'weights.png')


def integers(text):
    return np.frombuffer(base64.b64decode(text), '<i2').astype(float)


def positions(data, text, *shape):
    return np.array(data['origin']) + data['step'] * integers(text).reshape(*shape, 3)


# Content of the page.


@pytest.mark.parametrize('topic', ['/pose_mixture', '/smoothed_pose_mixture'])
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


def with_beliefs(message):
    """A mixture that, if a posterior, has reliabilities of cues; the last one lacks depth."""
    if message.kind == MixtureKind.POSTERIOR:
        i = STAMPS.index(time_ns(message.header.stamp))
        message.existence_probability = 1.0 - 0.1 * i
        message.cue_names = ['silhouette', 'track', 'depth'][: 2 if i == FRAMES - 1 else 3]
        message.cue_probabilities = np.array([0.125 * i, 0.5, 0.25])[: len(message.cue_names)]
    return message


@pytest.mark.usefixtures('no_pictures')
def test_beliefs_are_those_of_the_bag(data, body, poses, tmp_path):
    assert [(layer['existence'], layer['cues']) for layer in data['layers']] == [(None, {})] * 2
    out = write_out(tmp_path / 'out', body, poses, change=with_beliefs)
    posterior, smoothed = data_of(make(out, tmp_path / 'report'))['layers']
    assert (smoothed['existence'], smoothed['cues']) == (None, {})
    assert np.allclose(posterior['existence'], 1.0 - 0.1 * np.arange(FRAMES))
    assert list(posterior['cues']) == ['silhouette', 'track', 'depth']
    assert np.allclose(posterior['cues']['silhouette'], 0.125 * np.arange(FRAMES))
    assert posterior['cues']['track'] == [0.5] * FRAMES
    assert posterior['cues']['depth'] == [*[0.25] * (FRAMES - 1), None]


def test_trajectories_are_those_of_the_bag(made, data, body):
    (topic,) = data['trajectories']
    assert topic['ends'] == list(PATH_JOINTS)
    with BagReader(made.out) as bag:
        messages = [stored.message for stored in bag.messages(['trajectory_mixture'])]
    assert len(topic['windows']) == len(messages) == FRAMES
    for window, message in zip(topic['windows'], messages, strict=True):
        assert np.allclose(window['weights'], [c.weight for c in message.components], atol=1e-5)
        assert np.allclose(window['free_energy'], message.free_energy, atol=1e-4)
        steps = len(message.stamps)
        assert len(window['times']) == steps
        means = [c.means.reshape(steps, -1) for c in message.components[:MAX_TRAJECTORIES]]
        joints = body.joint_positions(np.concatenate(means))
        ways = joints[:, body.skeleton.joint_index(PATH_JOINTS)]
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
    trajectories = data['scores']['topics']['/trajectory_mixture']
    assert trajectories['calibration'] == {'together': None, 'each': None, 'absolute': None}
    assert any(note.startswith('/trajectory_mixture') for note in data['notes'])


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


@pytest.mark.usefixtures('no_pictures')
def test_the_same_bag_gives_the_same_page(made, page, tmp_path):
    assert page == make(
        made.out, tmp_path / 'again', '--images', made.images, '--truth', made.truth
    )


def test_without_images_and_truth(made, tmp_path):
    found = data_of(make(made.out, tmp_path / 'report'))
    assert (found['images'], found['truth'], found['scores']) == (None, None, None)
    assert found['layers'][0]['pixels'] is None
    names = {path.name for path in (tmp_path / 'report').iterdir()}
    assert names == {'report.html', 'side_views.png', 'weights.png', 'free_energy.png'}


def test_chosen_topics_and_fewer_times(made, tmp_path):
    options = ['--topic', 'smoothed_pose_mixture', '--times', '4', '--truth', made.truth]
    found = data_of(make(made.out, tmp_path / 'report', *options))
    assert [layer['topic'] for layer in found['layers']] == ['/smoothed_pose_mixture']
    assert found['trajectories'] == []
    assert np.allclose(found['times'], [0.0, 0.2, 0.4, 0.6])
    assert found['scores']['topics']['/smoothed_pose_mixture']['frames'] == FRAMES
    assert found['notes'] == [f'4 of {FRAMES} times are shown']


@pytest.mark.usefixtures('no_pictures')
def test_bag_in_a_namespace(body, poses, tmp_path):
    """Topics are found in a person's namespace; a relative name is enough."""
    place = '/humans/bodies/anna'
    out = write_out(tmp_path / 'out', body, poses, overlay=True, namespace=place)
    found = data_of(make(out, tmp_path / 'report', '--topic', 'pose_mixture'))
    assert [layer['topic'] for layer in found['layers']] == [f'{place}/pose_mixture']
    assert found['truth']['source'].endswith(f'({place}/ground_truth)')
    assert len(found['images']['jpegs']) == FRAMES  # of the overlay


@pytest.mark.usefixtures('no_pictures')
def test_images_without_anybody(made, body, poses, tmp_path, capsys):
    """Every answered image is shown, also if no image has a person."""
    answered = [STAMPS[0] - 100_000_000, *STAMPS]
    nobody = tmp_path / 'nobody'
    somebody = write_out(tmp_path / 'some', body, poses, truth=False)
    with BagWriter(nobody) as bag:
        bag.add_topic('pose_mixture', POSE_MIXTURE)
        for stamp in answered:
            bag.write('keep_out', stamp, keep_out(stamp, reason='no scene'))
        # For a time without an image.
        bag.write('keep_out', STAMPS[-1] + 1, keep_out(STAMPS[-1] + 1, KeepOutState.STALE))
    images = write_images(tmp_path / 'images', answered)
    found = data_of(make(nobody, tmp_path / 'first', '--images', images, '--truth', made.truth))
    assert np.allclose(found['times'], np.arange(FRAMES + 1) / 10)
    assert found['layers'] == []
    assert found['notes'] == [f'nobody is found at {FRAMES + 1} of {FRAMES + 1} times: no scene']
    assert all(found['images']['jpegs'])
    scores = found['scores']['topics']['/pose_mixture']
    assert (scores['frames'], scores['missing'], scores['heaviest_mm']) == (0, FRAMES, None)
    with BagReader(somebody) as source, BagWriter(tmp_path / 'out') as bag:
        for stored in source.messages():
            bag.write(stored.topic, stored.log_time_ns, stored.message)
        for stamp in answered:
            bag.write('keep_out', stamp, keep_out(stamp))
    found = data_of(make(tmp_path / 'out', tmp_path / 'second', '--images', images))
    assert found['notes'] == [f'nobody is found at 1 of {FRAMES + 1} times']
    assert [bool(weights) for weights in found['layers'][0]['weights']] == [False, *[True] * FRAMES]


def keep_out(stamp, state=KeepOutState.UNKNOWN, reason=''):
    nothing = np.empty((0, 3))
    content = KeepOut(stamp, FRAME_ID, state, nothing, nothing, np.empty(0), reason=reason)
    return keep_out_message(MESSAGES, content)


@pytest.mark.usefixtures('no_pictures')
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


# Size of the page.


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
    # If even the smallest images are too large, some are left out.
    assert (len(strip.jpegs) == FRAMES) == (each > 1_500)


@pytest.mark.usefixtures('no_pictures')
def test_times_are_left_out_where_the_data_get_too_large(made, tmp_path, monkeypatch):
    size = data_size(read_mixtures(made.out))
    monkeypatch.setattr(report, 'DATA_BYTES', size // 2)
    data = data_of(make(made.out, tmp_path / 'report'))
    assert len(data['times']) == 3


# Errors.


def fails(tmp_path, capsys, out, *options):
    """The error line of the command, which must not write anything."""
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
    empty = tmp_path / 'empty.mcap'
    empty.write_bytes(b'')
    assert str(empty) in fails(tmp_path, capsys, empty)
    line = fails(tmp_path, capsys, made.out, '--images', made.out)
    assert 'no topic of type' in line
    other = write_images(tmp_path / 'other', [stamp + 1 for stamp in STAMPS])
    line = fails(tmp_path, capsys, made.out, '--images', other)
    assert 'is this the bag that was tracked?' in line


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
    assert 'name those of one camera with --topic' in fails(tmp_path, capsys, out)


@pytest.mark.usefixtures('no_pictures')
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


# The floor.

UP = np.array([0.0, -0.8, -0.6])


def with_ground(path, body, poses, *, frame=FRAME_ID, height=1.5, topics=('ground',), spoil=None):
    """A bag of mixtures with messages about the floor for all images except the first."""

    def message(stamp):
        contacts = {'left_foot': 0.9, 'right_foot': 0.1}
        made = ground_message(MESSAGES, GroundState(stamp, frame, UP, 0.1, height, 0.1, contacts))
        if spoil is not None:
            spoil(made)
        return made

    with BagReader(write_out(path / 'source', body, poses)) as source, BagWriter(path / 'b') as bag:
        for stored in source.messages():
            bag.write(stored.topic, stored.log_time_ns, stored.message)
        for topic in topics:
            for stamp in STAMPS[1:]:
                bag.write(topic, stamp, message(stamp))
    return path / 'b'


@pytest.mark.usefixtures('no_pictures')
def test_floor_is_that_of_the_bag(body, poses, tmp_path):
    bag = with_ground(tmp_path, body, poses)
    ground = data_of(make(bag, tmp_path / 'report', '--topic', 'pose_mixture'))['ground']
    assert ground['planes'] == [None, *[[0.0, -0.8, -0.6, 1.5]] * (FRAMES - 1)]
    assert ground['contacts'] == [{}, *[{'left': 0.9, 'right': 0.1}] * (FRAMES - 1)]


def test_floor_that_contradicts_itself(body, poses, tmp_path, capsys):
    bag = with_ground(tmp_path, body, poses, spoil=lambda m: setattr(m, 'height', 7.0))
    assert report.main([str(bag), '-o', str(tmp_path / 'report'), '--quiet']) == 1
    assert f'ground at {STAMPS[1]} ns: ground: plane is' in capsys.readouterr().err
