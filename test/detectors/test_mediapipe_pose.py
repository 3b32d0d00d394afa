"""MediaPipe Pose in a process of its own: what it finds, and what goes wrong without it."""

from __future__ import annotations

import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hmt_ros.detectors.mediapipe_pose import PYTHON, DetectorError, MediaPipePose
from hmt_ros.detectors.mediapipe_worker import LANDMARKS, REPLY, REQUEST
from hmt_ros.image.keypoint_schemes import schemes
from msg_tools import BagReader
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

ROOT = Path(__file__).resolve().parents[2]
CLIP = Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared')) / 'video' / 'wander'

IMAGE = np.full((48, 64, 3), 90, np.uint8)
# In place of MediaPipe: somebody stands where the image is not grey. Images before a new sequence
# are counted in the visibility of the first landmark.
STAND_IN = """
import types, sys
import numpy as np

class Point:
    def __init__(self, x, y, z, visibility=0.5):
        self.x, self.y, self.z, self.visibility = x, y, z, visibility

class Pose:
    def __init__(self, model_complexity, enable_segmentation):
        assert model_complexity == 1
        self.masked, self.images = enable_segmentation, 0
    def __enter__(self):
        return self
    def __exit__(self, *_):
        pass
    def reset(self):
        self.images = 0
    def process(self, image):
        print('noise on stdout')
        self.images += 1
        seen = (image != 90).any(2)
        if image[0, 0, 0] == 1:
            sys.exit('the model is broken')
        if not seen.any():
            return types.SimpleNamespace(
                pose_landmarks=None, pose_world_landmarks=None, segmentation_mask=None)
        assert image[seen].mean(0).argmax() == 0, 'RGB'
        rows, columns = seen.nonzero()
        (h, w), v, u = seen.shape, rows.mean() + 0.5, columns.mean() + 0.5
        points = [Point(u / w, v / h, 0, self.images / 100)] + 32 * [Point(0.5, 0.25, 0)]
        world = [Point(0.1 * i, 0.2, -0.3) for i in range(33)]
        of = lambda points: types.SimpleNamespace(landmark=points)
        return types.SimpleNamespace(
            pose_landmarks=of(points), pose_world_landmarks=of(world),
            segmentation_mask=seen.astype(np.float32) if self.masked else None)

solutions = types.SimpleNamespace(pose=types.SimpleNamespace(Pose=Pose))
"""


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """An interpreter that imports a stand-in as MediaPipe."""
    (tmp_path / 'mediapipe.py').write_text(STAND_IN, 'utf-8')
    path = tmp_path / 'python'
    path.write_text(f'#!/bin/sh\nPYTHONPATH={tmp_path} exec {sys.executable} "$@"\n', 'utf-8')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def somebody(column: int = 20) -> np.ndarray:
    image = IMAGE.copy()
    image[10:30, column : column + 10] = (10, 20, 200)
    return image


def test_landmarks_are_keypoints(stand_in: str) -> None:
    with MediaPipePose(stand_in) as detector:
        assert detector.detect(IMAGE, 0) is None
        found = detector.detect(somebody(), 1)
        assert detector.mask is None
    assert found is not None
    assert found.names == schemes()['mediapipe33'].names
    # The centre of the first pixel is at (0, 0).
    np.testing.assert_allclose(found.pixels[:2], [[24.5, 19.5], [31.5, 11.5]])
    np.testing.assert_allclose(found.confidences[:2], [0.02, 0.5])
    assert found.positions is not None
    np.testing.assert_allclose(found.positions[2], [0.2, 0.2, -0.3])


def test_a_mask_where_it_is_wanted(stand_in: str) -> None:
    with MediaPipePose(stand_in, with_mask=True) as detector:
        detector.detect(somebody(), 0)
        assert detector.mask is not None
        np.testing.assert_array_equal(detector.mask, (somebody() != 90).any(2))
        detector.detect(IMAGE, 1)
        assert not detector.mask.any()


def test_jumps_in_time_begin_a_new_sequence(stand_in: str) -> None:
    stamps = [10, 20, 20, 5, 15, 2_000_000_000]
    with MediaPipePose(stand_in) as detector:
        found = [detector.detect(somebody(), stamp) for stamp in stamps]
    counts = [round(100 * each.confidences[0]) for each in found if each is not None]
    assert counts == [1, 2, 3, 1, 2, 1]


def test_images_of_any_layout(stand_in: str) -> None:
    with MediaPipePose(stand_in) as detector:
        whole = np.tile(somebody(), (1, 2, 1))
        found = detector.detect(whole[:, :64], 0)
    assert found is not None
    np.testing.assert_allclose(found.pixels[0], [24.5, 19.5])


def process_of(detector: MediaPipePose) -> subprocess.Popen[bytes]:
    worker = detector._worker
    assert worker is not None
    process: subprocess.Popen[bytes] = worker.end.peek()[2][0]
    return process


def test_a_detector_that_ends_is_told_and_started_again(stand_in: str) -> None:
    with MediaPipePose(stand_in) as detector:
        broken = IMAGE.copy()
        broken[0, 0] = 1
        with pytest.raises(DetectorError, match=r'has ended: the model is broken$'):
            detector.detect(broken, 0)
        assert detector.detect(somebody(), 1) is not None
        os.kill(process_of(detector).pid, signal.SIGKILL)
        with pytest.raises(DetectorError, match=r'has ended: (it says|noise)'):
            detector.detect(somebody(), 2)
        assert detector.detect(somebody(), 3) is not None


def test_its_process_ends_with_it(stand_in: str) -> None:
    detector = MediaPipePose(stand_in)
    process = process_of(detector)
    assert process.poll() is None
    del detector
    assert process.poll() is not None


@pytest.mark.parametrize('python', ['/nowhere/python', '/bin/false'])
def test_without_mediapipe_one_line_says_what_to_do(
    python: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PYTHON, python)
    with pytest.raises(DetectorError) as caught:
        MediaPipePose()
    text = str(caught.value)
    assert text.startswith(f'{python} can not run MediaPipe: run "make mediapipe"')
    assert 'pip install mediapipe==0.10.21' in text
    assert '\n' not in text


def test_sizes_on_the_wire() -> None:
    assert (REQUEST.size, REPLY.size) == (9, 1)
    assert len(schemes()['mediapipe33'].names) == LANDMARKS


def test_mediapipe_itself(mediapipe: str) -> None:
    """It finds what it found when the clip was made, to the last bit but one."""
    if not CLIP.is_dir():
        pytest.skip(f'no development clip in {CLIP} (set HMT_SHARED)')
    with np.load(CLIP / 'keypoints_mediapipe.npz') as file:
        known = {name: file[name] for name in ('stamps', 'pixels', 'visibility', 'world')}
    with MediaPipePose(mediapipe) as detector, BagReader(CLIP) as bag:
        for index, stored in zip(range(10), bag.messages(['image/compressed'])):
            stamp = time_ns(stored.message.header.stamp)
            assert stamp == known['stamps'][index]
            found = detector.detect(decode_image(stored.message), stamp)
            assert found is not None
            np.testing.assert_allclose(found.pixels, known['pixels'][index], atol=0.5)
            np.testing.assert_allclose(found.confidences, known['visibility'][index], atol=0.02)
            np.testing.assert_allclose(found.positions, known['world'][index], atol=0.01)
