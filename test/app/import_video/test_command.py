import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from hmt_ros.app.import_video import command
from hmt_ros.app.replay.inputs import recorded_input
from hmt_ros.detectors.people import SeenPerson
from hmt_ros.detectors.registry import DETECTORS
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools import BagReader
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import START_NS, time_ns
from msg_tools.messages.images import decode_image, decode_mask

NAMES = ('left_hip', 'right_hip', 'left_knee')


def run(source, out, *options, fov='60'):
    view = ['--fov', fov] if fov else []
    return command.main([str(source), '-o', str(out), '--quiet', *view, *map(str, options)])


def content(bag):
    """Messages by topic."""
    found = {}
    with BagReader(bag) as reader:
        for stored in reader.messages():
            stamp = time_ns(stored.message.header.stamp)
            assert stored.log_time_ns == stamp
            found.setdefault(stored.topic, []).append((stamp, stored.message))
    return found


def arrays(path, rows, **changed):
    person = np.array([[10.0, 5], [14, 5], [10, 15]])
    pixels = np.stack([person + np.array([i, 0]) for i in range(rows)])
    columns = {
        'landmark_names': np.array(NAMES),
        'pixels': pixels,
        'visibility': np.full((rows, 3), 0.5),
        'world': np.ones((rows, 3, 3)),
        'detected': np.arange(rows) != 2,
    }
    np.savez(path, **(columns | changed))
    return path


def test_video_with_keypoints(video, tmp_path, number_in):
    keypoints = arrays(tmp_path / 'k.npz', 10)
    assert run(video, tmp_path / 'bag', '--keypoints', keypoints) == 0
    found = content(tmp_path / 'bag')
    assert sorted(found) == ['/camera_info', '/image/compressed', '/keypoints', '/keypoints_3d']
    stamps = [START_NS + 40_000_000 * i for i in range(10)]
    for topic, messages in found.items():
        assert [stamp for stamp, _ in messages] == stamps, topic
        assert {x.header.frame_id for _, x in messages} == {'camera_optical_frame'}
    assert [number_in(decode_image(x)) for _, x in found['/image/compressed']] == [*range(10)]
    camera = camera_from_info(found['/camera_info'][0][1], (64, 48))
    assert camera.fx == pytest.approx(32 / np.tan(np.radians(30)))
    messages = [x for _, x in found['/keypoints']]
    assert [len(x.names) for x in messages] == [3, 3, 0, 3, 3, 3, 3, 3, 3, 3]
    assert tuple(messages[4].names) == NAMES
    assert list(messages[4].u) == [14, 18, 14]
    assert list(messages[4].confidence) == [0.5] * 3
    assert len(messages[4].covariance) == 0
    lifted = [x for _, x in found['/keypoints_3d']]
    assert [len(x.names) for x in lifted] == [len(x.names) for x in messages]
    assert list(lifted[4].z) == [1.0] * 3
    with BagReader(tmp_path / 'bag') as bag:
        recorded = recorded_input(bag)
        assert recorded.image.name == '/image/compressed'
        assert recorded.of('keypoints') is not None


def test_jpeg_files_are_copied_and_masks_are_found_by_name(folder, tmp_path):
    masks = tmp_path / 'masks'
    masks.mkdir()
    picture = np.zeros((48, 64), np.uint8)
    picture[10:20, 30:40] = 255
    for i in (1, 3):
        assert cv2.imwrite(str(masks / f'img_{i}.png'), picture)
    options = ['--fps', 10, '--masks', masks, '--first-stamp', 5]
    assert run(folder, tmp_path / 'bag', *options) == 0
    found = content(tmp_path / 'bag')
    files = [(folder / f'img_{i}.jpg').read_bytes() for i in range(1, 11)]
    assert [bytes(x.data) for _, x in found['/image/compressed']] == files
    assert [stamp for stamp, _ in found['/mask']] == [5, 200_000_005]
    assert np.array_equal(decode_mask(found['/mask'][0][1]), picture > 0)


def test_masks_of_a_video(video, tmp_path):
    size = (64, 48)
    writer = cv2.VideoWriter(
        str(tmp_path / 'masks.mp4'), cv2.VideoWriter_fourcc(*'mp4v'), 25.0, size
    )
    for i in range(10):
        picture = np.zeros((48, 64, 3), np.uint8)
        picture[:, : 8 + 4 * i] = 255
        writer.write(picture)
    writer.release()
    options = ['--masks', tmp_path / 'masks.mp4', '--start', '0.1', '--every', 3]
    assert run(video, tmp_path / 'bag', *options) == 0
    masks = [decode_mask(x) for _, x in content(tmp_path / 'bag')['/mask']]
    assert [round(x.mean() * 64) for x in masks] == pytest.approx([20, 32, 44], abs=1)


def test_same_command_same_bytes(video, tmp_path):
    for name in ('a', 'b'):
        assert run(video, tmp_path / name / 'bag') == 0
    one, other = ((tmp_path / x / 'bag' / 'bag.mcap').read_bytes() for x in ('a', 'b'))
    assert one == other
    assert run(video, tmp_path / 'a' / 'bag', '--overwrite', '--jpeg-quality', '20') == 0
    assert (tmp_path / 'a' / 'bag' / 'bag.mcap').read_bytes() != one


def test_one_of_several_persons(video, tmp_path):
    def entry(i, u, track):
        pixels = np.array([[u, 5.0, 1], [u + 4, 5, 1], [u, 15, 1]] + [[0.0, 0, 0]] * 14)
        return {'image_id': i + 1, 'keypoints': pixels.reshape(-1).tolist(), 'track_id': track}

    entries = [entry(i, u, k) for i in range(10) for u, k in ((10.0 + i, 8), (50.0 - i, 9))]
    (tmp_path / 'k.json').write_text(json.dumps(entries), 'utf-8')
    options = ['--keypoints', tmp_path / 'k.json', '--first-number', 1, '--person', 'id:9']
    assert run(video, tmp_path / 'bag', *options) == 0
    columns = [x.u[0] for _, x in content(tmp_path / 'bag')['/keypoints']]
    assert columns == [50.0 - i for i in range(10)]


class FakePose:
    """Detector that finds the person in every second image, at the index of the call."""

    def __init__(self, *, with_mask):
        self.mask, self.calls, self.stamps, self._with_mask = None, 0, [], with_mask

    def detect(self, image, stamp_ns):
        self.calls += 1
        self.stamps.append(stamp_ns)
        if self._with_mask:
            self.mask = np.zeros(image.shape[:2], bool)
            self.mask[: self.calls] = True
        if self.calls % 2:
            return None
        pixels = np.full((3, 2), float(self.calls))
        return Keypoints(NAMES, pixels, np.tile(np.eye(2), (3, 1, 1)), np.ones(3), np.ones((3, 3)))


def test_detector(video, tmp_path, monkeypatch):
    made = []

    def pose(**options):
        made.append(FakePose(**options))
        return made[-1]

    monkeypatch.setitem(DETECTORS, 'mediapipe', replace(DETECTORS['mediapipe'], make=pose))
    options = ['--detector', 'mediapipe', '--detector-masks', '--every', 2]
    assert run(video, tmp_path / 'bag', *options) == 0
    found = content(tmp_path / 'bag')
    stamps = [START_NS + 80_000_000 * i for i in range(5)]
    assert made[0].stamps == stamps
    for topic in ('/keypoints', '/keypoints_3d', '/mask'):
        assert [stamp for stamp, _ in found[topic]] == stamps
    assert [len(x.names) for _, x in found['/keypoints']] == [0, 3, 0, 3, 0]
    assert [decode_mask(x).any(1).sum() for _, x in found['/mask']] == [1, 2, 3, 4, 5]


def test_detector_sees_square_pixels(video, with_pixel_aspect, tmp_path, monkeypatch):
    sizes = []

    class Pose(FakePose):
        def detect(self, image, stamp_ns):
            sizes.append(image.shape[:2])
            return super().detect(image, stamp_ns)

    monkeypatch.setitem(DETECTORS, 'mediapipe', replace(DETECTORS['mediapipe'], make=Pose))
    video.write_bytes(with_pixel_aspect(video.read_bytes(), 2, 1))
    options = ['--detector', 'mediapipe', '--detector-masks']
    assert run(video, tmp_path / 'bag', *options) == 0
    assert set(sizes) == {(48, 128)}
    found = content(tmp_path / 'bag')
    second = found['/keypoints'][1][1]
    # The detector's (2, 2) in the image, where the centre of the first pixel is 0.
    assert (second.u[0], second.v[0]) == (0.75, 2.0)
    assert np.allclose(np.reshape(second.covariance, (3, 2, 2))[0], [[0.25, 0], [0, 1]])
    assert decode_mask(found['/mask'][3][1]).sum() == 4 * 64
    camera = camera_from_info(found['/camera_info'][0][1], (64, 48))
    assert camera.fx == pytest.approx(32 / np.tan(np.radians(30)))
    assert camera.fy == pytest.approx(2 * camera.fx)


class FakePeople:
    """Detector of two people, in every other image; it gets square pixels."""

    def __init__(self, most):
        self.most, self.calls = most, 0

    def detect(self, image, stamp_ns):
        assert image.shape[:2] == (48, 128)
        self.calls += 1
        if self.calls % 2 == 0:
            return []
        keypoints = Keypoints(NAMES, np.full((3, 2), 8.5), np.full((3, 2, 2), np.nan), np.ones(3))
        return [SeenPerson(f'p{i}', keypoints, np.array([[8.0, 4], [40, 44]])) for i in (1, 2)]


def test_several_people(video, with_pixel_aspect, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, 'PeopleDetector', FakePeople)
    video.write_bytes(with_pixel_aspect(video.read_bytes(), 2, 1))
    options = [str(video), '-o', str(tmp_path / 'bag'), '--fov', '60', '--people', '2']
    assert command.main(options) == 0
    assert '10 images, 5 with keypoints' in capsys.readouterr().out
    found = content(tmp_path / 'bag')
    assert not found.keys() & {'/keypoints', '/keypoints_3d'}
    assert [x.ids for _, x in found['/detections'][:2]] == [['p1', 'p2'], []]
    (_, first), *_ = found['/detections']
    assert [first.keypoints[0].u[0], first.keypoints[0].v[0]] == [4.0, 8.5]
    box = first.boxes[1]
    assert (box.x_offset, box.y_offset, box.width, box.height) == (4, 4, 16, 40)


def test_video_that_breaks_off_is_told(video, tmp_path, capsys):
    path = tmp_path / 'broken.avi'
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'MJPG'), 25.0, (64, 48))
    rng = np.random.default_rng(0)
    for _ in range(20):
        writer.write(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8))
    writer.release()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert run(path, tmp_path / 'bag') == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert 'of the 20 frames that its header announces can be read' in line
    # A detector run on the whole video has keypoints of all its frames.
    for found in (arrays(tmp_path / 'all.npz', 20), tmp_path / 'all.csv'):
        if found.suffix == '.csv':
            found.write_text('frame,a_u,a_v\n' + ''.join(f'{i},5,6\n' for i in range(20)), 'utf-8')
        out = tmp_path / found.suffix
        assert run(path, out, '--keypoints', found) == 0
        topics = content(out)
        assert 0 < len(topics['/keypoints']) == len(topics['/image/compressed']) < 20
    assert run(path, tmp_path / 'few', '--keypoints', arrays(tmp_path / 'few.npz', 19)) == 1


def test_a_part_of_the_video_in_which_nobody_is(video, tmp_path, capsys):
    found = arrays(tmp_path / 'late.npz', 10, detected=np.arange(10) > 6)
    out = tmp_path / 'bag'
    assert run(video, out, '--keypoints', found, '--end', '0.2') == 0
    assert 'none of the 5 imported frames has keypoints' in capsys.readouterr().err
    topics = content(out)
    for topic in ('/keypoints', '/keypoints_3d'):
        assert [len(message.names) for _, message in topics[topic]] == [0] * 5
    assert run(video, tmp_path / 'one', '--keypoints', found, '--person', 'index:1') == 1


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--keypoints', '{}/none.json'], 'none.json: no such file'),
        (['--keypoints', '{}/nine.npz'], 'nine.npz has 9 rows, but'),
        (['--keypoints', '{}/late.csv'], 'late.csv has frame 10, but'),
        (['--keypoints', '{}/far.npz'], '27 of 27 keypoints lie outside of the images'),
        (
            ['--keypoints', '{}/ten.npz', '--person', 'index:3'],
            'no frame has a person 3: the last is --person index:0',
        ),
        (['--keypoints', '{}/ten.npz', '--person', 'tall'], '--person: wanted largest, nearest,'),
        (['--keypoints', 'k', '--detector', 'mediapipe'], '--detector: not allowed with argument'),
        (['--masks', '{}/wide'], 'mask 0003.png has 32x24 pixels, wanted the 64x48 of its frame'),
        (['--masks', '{}/full'], 'mask 3.png is zero nowhere'),
        (['--masks', '{}/late'], 'late has frame 12, but'),
        (['--masks', '{}/named'], 'person.png is not the name of a frame and has no number'),
        (['--people', '2', '--detector', 'mediapipe'], '--detector: not allowed with argument'),
        (['--people', '0'], '--people: wanted a whole number from 1 to 20'),
        (['--detector-masks'], '--detector-masks goes with --detector'),
        (['--camera', 'c.yaml'], '--camera: not allowed with argument --fov'),
        (['--detector', 'mediapipe', '--person', 'track:1'], '--person goes with --keypoints'),
        (['--vertical-fov', '50'], '--vertical-fov: not allowed with argument --fov'),
        (['--fov', '0.5'], "--fov: wanted an angle from 1 to 150 degrees, saw '0.5'"),
        (['--start', '5'], 'no frame was read of 10; see --start and --end'),
        (['--start', '2', '--end', '1'], '--start 2 is not before --end 1'),
        (['--every', '0'], '--every: wanted a whole number from 1'),
        (['--fps', '0'], '--fps: wanted a number from 0.01 to 1000'),
    ],
)
def test_bad_input_is_one_line(options, message, video, tmp_path, capfd):
    arrays(tmp_path / 'nine.npz', 9)
    arrays(tmp_path / 'ten.npz', 10)
    arrays(tmp_path / 'far.npz', 10, pixels=np.full((10, 3, 2), 500.0))
    (tmp_path / 'late.csv').write_text('frame,a_u,a_v\n1,5,6\n10,5,6\n', 'utf-8')
    for name, shape, file in (
        ('wide', (24, 32), '0003.png'),
        ('full', (48, 64), '3.png'),
        ('late', (48, 64), '12.png'),
        ('named', (48, 64), 'person.png'),
    ):
        (tmp_path / name).mkdir()
        assert cv2.imwrite(str(tmp_path / name / file), np.full(shape, 255, np.uint8))
    out = tmp_path / 'new' / 'bag'
    given = [x.format(tmp_path) for x in options]
    assert run(video, out, *given) == 1
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith('import-video: ')
    assert message in lines[0]
    assert not out.parent.exists() or not [*out.parent.iterdir()]


def test_images_of_several_sizes(folder, tmp_path, capsys):
    assert cv2.imwrite(str(folder / 'img_5.jpg'), np.zeros((40, 64, 3), np.uint8))
    assert run(folder, tmp_path / 'bag', '--fps', 10) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'img_5.jpg has 64x40 pixels, the frames before it 64x48; wanted one size' in line
    assert not (tmp_path / 'bag').exists()


def test_a_mirrored_recording(video, tmp_path):
    """Frames, keypoints, positions and masks are mirrored; sides swap their names."""
    (tmp_path / 'masks').mkdir()
    picture = np.zeros((48, 64), np.uint8)
    picture[:, :10] = 255
    for i in range(10):
        assert cv2.imwrite(str(tmp_path / 'masks' / f'{i}.png'), picture)
    options = ['--keypoints', arrays(tmp_path / 'k.npz', 10), '--masks', tmp_path / 'masks']
    for name, more in (('plain', []), ('turned', ['--mirror'])):
        assert run(video, tmp_path / name, *options, *more) == 0
    plain, turned = content(tmp_path / 'plain'), content(tmp_path / 'turned')
    before, after = (decode_image(x['/image/compressed'][3][1]) for x in (plain, turned))
    assert np.abs(before[:, ::-1].astype(int) - after).mean() < 2.0
    assert np.array_equal(
        decode_mask(turned['/mask'][3][1]), decode_mask(plain['/mask'][3][1])[:, ::-1]
    )
    one, other = plain['/keypoints'][3][1], turned['/keypoints'][3][1]
    assert tuple(other.names) == ('right_hip', 'left_hip', 'right_knee')
    assert list(other.u) == [63 - x for x in one.u]
    assert list(other.v) == list(one.v)
    assert list(turned['/keypoints_3d'][3][1].x) == [-1.0] * 3
