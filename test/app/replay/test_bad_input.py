"""For any wrong input: one error line, exit code 1, and no bag."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hmt_ros.app.replay.command import main
from hmt_ros.body import Camera
from msg_tools import BagReader, BagWriter, RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.headers import header_message
from msg_tools.messages.images import compressed_image_message, image_message
from msg_tools.messages.keep_out import KeepOutState

ROOT = Path(__file__).resolve().parents[3]
SHARED = Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared'))
REACH = ROOT / 'bags' / 'reach'
MESSAGES = RosbagsMessages()
CAMERA = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
START_NS = 1_700_000_000_000_000_000
SUBJECT = f"""\
stamp_ns: {START_NS}
keypoints: {{left_hip: [30, 30], right_hip: [34, 30], neck: [32, 20], head: [32, 15]}}
"""


def stamp(index):
    return START_NS + 100_000_000 * index


def image(index, **fields):
    picture = np.full((48, 64, 3), 100 + index, np.uint8)
    message = image_message(MESSAGES, picture, stamp(index), 'lens')
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def compressed(index, data=None):
    picture = np.full((48, 64, 3), 100 + index, np.uint8)
    message = compressed_image_message(MESSAGES, picture, stamp(index), 'lens')
    if data is not None:
        message.data = np.frombuffer(data, np.uint8)
    return message


def info(index, **fields):
    message = camera_info_message(MESSAGES, CAMERA, stamp(index), 'lens')
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def keypoints(index, u, **fields):
    return MESSAGES.create(
        'hmt_msgs/msg/Keypoints2D',
        header=header_message(MESSAGES, stamp(index), 'lens'),
        names=['head', 'neck'],
        u=np.array(u),
        v=np.array([1.0, 2.0]),
        **fields,
    )


def write(folder, *entries):
    """Writes a bag of (topic, message), a hundredth of a second apart."""
    with BagWriter(folder) as bag:
        for index, (topic, message) in enumerate(entries):
            bag.write(topic, START_NS + 10_000_000 * index, message)
    return folder


def fails(bag, tmp_path, capsys, *options, subject=SUBJECT):
    """The error line of replay."""
    file = tmp_path / 'subject.yaml'
    if subject is not None:
        file.write_text(subject)
    out = tmp_path / 'new' / 'out'
    assert main([str(bag), '-o', str(out), '--subject', str(file), *options]) == 1
    streams = capsys.readouterr()
    (line,) = streams.err.splitlines()
    assert streams.out == ''
    assert not (tmp_path / 'new').exists() or list((tmp_path / 'new').iterdir()) == []
    assert line.startswith('replay: ')
    return line


IMAGE, INFO = ('image', image(0)), ('camera_info', info(0))


@pytest.mark.parametrize(
    ('entries', 'message'),
    [
        pytest.param([INFO], 'has no topic of type CompressedImage or Image', id='no images'),
        pytest.param([IMAGE], 'has images on /image, but no camera_info', id='no camera_info'),
        pytest.param(
            [('camera_info', info(0, k=np.zeros(9))), IMAGE],
            'camera_info has k[0] = 0: uncalibrated',
            id='uncalibrated',
        ),
        pytest.param(
            [INFO, ('image', image(0, encoding='yuv9'))],
            "image encoding 'yuv9' is not known, wanted one of mono8",
            id='unknown encoding',
        ),
        pytest.param(
            [INFO, ('image/compressed', compressed(0, bytes(compressed(0).data)[:-200]))],
            'breaks off or is damaged',
            id='damaged picture',
        ),
        pytest.param(
            [('camera_info', info(0, width=32, height=32)), IMAGE],
            'image has 64x48 pixels, wanted the 32x32 of camera_info',
            id='size',
        ),
        pytest.param(
            [INFO, ('keypoints', keypoints(0, [np.nan, 1.0])), IMAGE],
            'keypoint head lies at (nan, 1.0), wanted numbers within',
            id='nan in keypoints',
        ),
        pytest.param(
            [INFO, ('image', image(-2)), ('image', image(-3))],
            f'image of {stamp(-3)} ns comes after one of {stamp(-2)} ns',
            id='time jumps back',
        ),
        pytest.param(
            [INFO, ('image', image(-2)), ('image', image(-1))],
            f'joints of the subject file were seen at {stamp(0)} ns, after the last image',
            id='subject of another bag',
        ),
        pytest.param(
            [INFO, ('/a/image', image(0)), ('/b/image', image(0))],
            'name one of /a/image, /b/image by --image-topic',
            id='several cameras',
        ),
        pytest.param(
            [('a/info', info(0)), ('b/info', info(0)), IMAGE],
            'name one of /a/info, /b/info by --camera-info-topic',
            id='several calibrations',
        ),
    ],
)
def test_bags(entries, message, tmp_path, capsys):
    line = fails(write(tmp_path / 'bag', *entries), tmp_path, capsys)
    assert message in line
    assert str(tmp_path / 'bag') in line


def test_damaged_bags(tmp_path, capsys):
    whole = (REACH / 'reach.mcap').read_bytes()
    broken = tmp_path / 'broken.mcap'
    for data, message in (
        (whole[:40_000] + b'\x00' * 64 + whole[40_064:], 'is damaged'),
        (b'', 'is empty'),
        (b'no recording at all', 'is not a bag'),
    ):
        broken.write_bytes(data)
        line = fails(broken, tmp_path, capsys, '--quiet')
        assert message in line
        assert str(broken) in line


def test_a_bag_that_a_crash_cut_off(tmp_path):
    """Every command reads it up to its last complete message, and reports that in one line."""
    whole, cut = (REACH / 'reach.mcap').read_bytes(), tmp_path / 'cut.mcap'
    cut.write_bytes(whole[: len(whole) * 9 // 10])

    def run(*words):
        command = [sys.executable, '-m', 'hmt_ros', *map(str, words), '--quiet']
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        (line,) = done.stderr.splitlines()
        assert line.startswith(f'{cut} breaks off: ')
        assert '`mcap recover`' in line
        assert '`ros2 bag reindex`' in line

    out = tmp_path / 'out'
    start = ['--subject', REACH / 'subject.yaml', '--background', REACH / 'background.png']
    run('replay', cut, '-o', out, '--no-smoother', '--set', 'max_hypotheses=4', *start)
    with BagReader(out) as bag, BagReader(REACH) as reach:
        images = reach.topic('image/compressed').message_count
        assert 0.5 * images < bag.message_count(['pose_mixture']) < images
    cut.write_bytes((out / 'out.mcap').read_bytes()[:-2000])
    run('evaluate', cut, '--json')
    run('export', cut, '-o', tmp_path / 'motion.csv')
    run('report', cut, '-o', tmp_path / 'report')


def test_folders_and_files_that_are_no_bags(tmp_path, capsys):
    assert 'No such file' in fails(tmp_path / 'nothing', tmp_path, capsys)
    (tmp_path / 'folder').mkdir()
    assert 'has no metadata.yaml' in fails(tmp_path / 'folder', tmp_path, capsys)
    (tmp_path / 'folder' / 'metadata.yaml').write_text('a: [')
    assert 'not YAML' in fails(tmp_path / 'folder', tmp_path, capsys)


@pytest.mark.skipif(
    not (SHARED / 'mcap').is_dir(), reason=f'no recordings of others in {SHARED}/mcap'
)
def test_recordings_of_others(tmp_path, capsys):
    files = sorted(
        path
        for path in (SHARED / 'mcap').rglob('*')
        if path.suffix in ('.mcap', '.bag', '.db3', '.zstd') and 'conformance' not in path.parts
    )
    assert len(files) > 10
    for path in files:
        line = fails(path, tmp_path, capsys)
        assert str(path) in line
        assert len(line) < 1000


@pytest.fixture
def good(tmp_path):
    return write(tmp_path / 'good', INFO, IMAGE)


@pytest.mark.parametrize(
    ('subject', 'message'),
    [
        (None, 'subject.yaml: can not be read (No such file'),
        (SUBJECT.replace('head', 'haed'), "human37 has no joint ['haed']; it has ["),
        (SUBJECT + 'segment_lengths_m: {tigh: 0.4}\n', "human37 has no length ['tigh']"),
    ],
)
def test_subject_files(good, subject, message, tmp_path, capsys):
    assert message in fails(good, tmp_path, capsys, subject=subject)


def test_nobody_is_seen_without_a_start(tmp_path, capsys):
    out = tmp_path / 'out'
    bag = write(tmp_path / 'bag', INFO, IMAGE)
    assert main([str(bag), '-o', str(out)]) == 0
    told, line = capsys.readouterr().err.splitlines()
    assert told == 'replay: no --subject: the track starts from a pose_prediction with components'
    assert 'nobody is found in its 1 images: give an image of the empty scene with' in line
    with BagReader(out) as written:
        (state,) = (stored.message.state for stored in written.messages(['keep_out']))
        assert state == KeepOutState.UNKNOWN
        assert not written.message_count(['pose_mixture'])


@pytest.mark.parametrize(
    ('option', 'message'),
    [
        (['--bme', 'nowhere.npz'], 'nowhere.npz: no such model; wanted a file, or one of'),
        (['--bme', str(REACH / 'metadata.yaml')], 'metadata.yaml: '),
        (['--set', 'bme.magic=1'], 'there is no parameter magic'),
        (['--set', 'bme.image_transport=raw'], 'is set by replay'),
        (
            ['--set', 'bme.stature=1.8', '--subject', str(REACH / 'subject.yaml')],
            '--set bme.stature=1.8: nothing is predicted without --bme',
        ),
    ],
)
def test_models_that_can_not_be(tmp_path, capsys, option, message):
    out = tmp_path / 'out'
    bag = write(tmp_path / 'bag', INFO, IMAGE)
    assert main([str(bag), '-o', str(out), '--quiet', *option]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert not out.exists()


def test_start_that_nothing_explains(good, tmp_path, capsys):
    subject = SUBJECT
    for place in ('[30, 30]', '[34, 30]', '[32, 20]', '[32, 15]'):
        subject = subject.replace(place, '[32, 24]')
    line = fails(good, tmp_path, capsys, subject=subject)
    assert f'no track starts at the image of {stamp(0)} ns' in line


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--background', 'nowhere.png'], 'nowhere.png: can not be read (No such file'),
        (['--background', str(REACH / 'subject.yaml')], 'subject.yaml: not a picture'),
        (['--background', str(REACH / 'background.png')], 'has 480x360 pixels, but the camera'),
        (['--config', 'nowhere.yaml'], 'nowhere.yaml: can not be read (No such file'),
        (['--seed', 'x'], 'argument --seed: invalid int value'),
        (['--set', 'max_hypotheses'], '--set max_hypotheses: wanted NAME=VALUE'),
        (['--set', 'max_hypothesis=3'], 'there is no parameter max_hypothesis; is max_hypotheses'),
        (['--set', 'image_transport=raw'], 'image_transport is set by replay'),
        (['--set', 'body_model=['], '--set body_model=['),
        (['--image-topic', 'imag'], 'has no topic imag; it has /camera_info, /image'),
        (['--image-topic', 'camera_info'], 'CameraInfo, wanted CompressedImage or Image'),
        (['--liev'], 'unrecognized arguments: --liev; see --help'),
    ],
)
def test_options(good, options, message, tmp_path, capsys):
    assert message in fails(good, tmp_path, capsys, *options)


def test_output_that_can_not_be_written(good, tmp_path, capsys):
    (tmp_path / 'subject.yaml').write_text(SUBJECT)
    (tmp_path / 'file').write_text('mine')
    for out in (tmp_path / 'file', tmp_path / 'file' / 'out', tmp_path / 'good'):
        command = [str(good), '-o', str(out), '--subject', str(tmp_path / 'subject.yaml')]
        assert main([*command, '--overwrite']) == 1
        assert len(capsys.readouterr().err.splitlines()) == 1
    assert (tmp_path / 'file').read_text() == 'mine'


def test_going_on_nevertheless(tmp_path, capsys):
    """With --keep-going, the valid half of a bag is tracked."""
    out, bag = tmp_path / 'out', tmp_path / 'bag'
    with BagReader(REACH) as reader:
        pictures = [m.message for m in reader.messages(['image/compressed'])][:2]
        camera = next(iter(reader.messages(['camera_info']))).message
    broken = compressed(0, b'\xff\xd8\xff\xe0')
    entries = [('camera_info', info(0, k=np.zeros(9))), ('camera_info', camera)]
    for picture in pictures:
        entries += [('image/compressed', broken), ('image/compressed', picture)]
        entries += [('image/compressed', picture)]
    write(bag, *entries)
    whole = (bag / 'bag.mcap').read_bytes()
    command = ['-o', str(out), '--subject', str(REACH / 'subject.yaml')]
    assert main([str(bag), *command]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith('(--keep-going skips such messages)')
    # The bag is cut off after its last messages.
    (bag / 'bag.mcap').write_bytes(whole[:-2000])
    assert main([str(bag), *command, '--keep-going']) == 0
    streams = capsys.readouterr()
    assert streams.out == f'{out}: 2 of 6 images tracked\n'
    told = streams.err.splitlines()
    wanted = (
        'uncalibrated',
        'camera_info has messages of the frames',
        'breaks off',
        'image has messages of the frames',
        'stamps that increase',
    )
    for text, part in zip(told, wanted, strict=True):
        assert text.startswith('replay: ')
        assert part in text
    with BagReader(out) as reader:
        assert reader.message_count(['pose_mixture']) == 2
