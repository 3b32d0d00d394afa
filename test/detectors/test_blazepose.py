"""BlazePose: geometry and filters, rules with stub networks, and the real networks."""

import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from hmt_ros.detectors import blazepose
from hmt_ros.detectors.blazepose import (
    BlazePose,
    Square,
    _anchors,
    _OneEuroFilter,
    _refined,
)
from hmt_ros.image.keypoint_schemes import schemes
from msg_tools import BagReader
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image

ROOT = Path(__file__).resolve().parents[2]
CLIP = Path(os.environ.get('HMT_SHARED', ROOT / '..' / 'shared')) / 'video' / 'wander'
INTERVAL = 33_333_000


# ---- Geometry and filters ----


@pytest.mark.parametrize('degrees', [0.0, 30.0, -100.0, 180.0])
def test_a_square_stands_upright_about_a_circle(degrees):
    angle = math.radians(degrees)
    centre = np.array([100.0, 80.0])
    head = centre + 40 * np.array([math.sin(angle), -math.cos(angle)])
    square = Square.about(np.stack([centre, head]))
    assert square.side == pytest.approx(2.5 * 40)
    # The circle's point is above the centre, at 40 of the 50 px to the upper side.
    np.testing.assert_allclose(
        square.corner + 100 * np.array([0.5, 0.1]) @ square.axes, head, atol=1e-9
    )


def test_a_square_sees_and_spreads():
    rows, columns = np.mgrid[:60, :80]
    image = np.stack([columns, rows, 0 * rows], axis=-1).astype(np.uint8)
    square = Square((40.0, 30.0), 32.0, math.pi / 2)
    seen = square.seen(image, 32, cv2.BORDER_CONSTANT)
    # Rotated by 90 degrees: right in the square is below in the image; RGB.
    np.testing.assert_array_equal(seen[4, 7], [0, 14 + 7, 56 - 4])
    spread = square.spread(seen[..., 2].astype(np.float32), (60, 80))
    np.testing.assert_allclose(spread[20:40, 30:50], columns[20:40, 30:50])
    assert not spread[:, :20].any()


def test_cells_of_the_first_network():
    anchors = _anchors()
    assert anchors.shape == (2254, 2)
    np.testing.assert_allclose(anchors[[0, 1, 2, 56]] * 224, [[4, 4], [4, 4], [12, 4], [4, 12]])
    np.testing.assert_allclose(anchors[-1] * 224, [208, 208])


def test_points_move_to_the_heat_about_them():
    rows, columns = np.mgrid[:64, :64]
    heat = np.full((64, 64, 4), -20.0, np.float32)
    peaks = [(20.4, 30.7), (1.0, 62.5), (40.0, 40.0), (10.0, 10.0)]
    for n, (u, v) in enumerate(peaks):
        heat[..., n] = 4 - 2 * ((columns - u) ** 2 + (rows - v) ** 2)
    heat[..., 2] -= 10
    points = np.array([(21.5, 29.9), (0.5, 61.0), (41.0, 41.0), (-3.0, 12.0)]) / 64
    found = _refined(points, heat)
    # By definition: the mean of nine by nine cells around the point's cell.
    for n in (0, 1):
        column, row = np.trunc(points[n] * 64)
        near = (abs(columns - column) <= 4) & (abs(rows - row) <= 4)
        weights = near / (1 + np.exp(-heat[..., n].clip(-80)))
        mean = [(weights * each).sum() / weights.sum() for each in (columns, rows)]
        np.testing.assert_allclose(found[n] * 64, mean, rtol=1e-6)
    # Too little heat, and a point outside.
    np.testing.assert_array_equal(found[2:], points[2:])


def test_the_one_euro_filter_number_by_number():
    rng = np.random.default_rng(3)
    values = np.cumsum(rng.normal(size=(20, 3, 2)), axis=0)
    intervals = rng.uniform(0.02, 0.1, 20)
    one = _OneEuroFilter(0.1, 5.0)
    found = np.array([one(x, dt, 7.0) for x, dt in zip(values, intervals)])
    for place in np.ndindex(3, 2):
        smoothed = last = values[(0, *place)]
        velocity = 0.0
        for step in range(1, 20):
            dt, new = intervals[step], values[(step, *place)]

            def share(cutoff, dt=dt):
                return 1 / (1 + 1 / (2 * math.pi * cutoff * dt))

            velocity += share(1.0) * ((new - last) / dt / 7.0 - velocity)
            smoothed += share(0.1 + 5.0 * abs(velocity)) * (new - smoothed)
            last = new
            assert found[(step, *place)] == pytest.approx(smoothed, rel=1e-12)


# ---- The rules, with stub networks ----


class StandIns:
    """Stub networks that see a person while `seen`, with counts of their calls."""

    def __init__(self):
        self.seen = True
        self.asked: list[str] = []

    def __call__(self, name):
        return self.person if name.startswith('pose_detection') else self.landmarks

    def person(self, image):
        self.asked.append('person')
        assert image.shape == (224, 224, 3)
        # Above and below the image the square is black.
        assert image.min() == -1.0
        boxes, scores = np.zeros((2254, 12), np.float32), np.full((2254, 1), -9.0, np.float32)
        if self.seen:
            # Two detections of one person, heads 8 px apart, and a less certain person elsewhere.
            for n, score, shift in ((1000, 2.0, 0.0), (1001, 2.0, 8.0), (0, 1.0, 0.0)):
                scores[n] = score
                boxes[n, 2:8] = 60.0, 60.0, 0.0, 40.0, shift, 0.0
        return [boxes, scores]

    def landmarks(self, image):
        self.asked.append('landmarks')
        assert image.shape == (256, 256, 3)
        flat = np.zeros((39, 5), np.float32)
        flat[:, :2] = 128
        flat[0] = 64, 192, 0, 3, 0
        # The circle: the middle, and 102.4 px above: the square stays as it is.
        flat[34, :2] = 128, 25.6
        world = np.zeros((39, 3), np.float32)
        world[1] = 0.1, 0.2, 0.3
        mask = np.full((256, 256, 1), -9.0, np.float32)
        mask[:128] = 9.0
        heat = np.full((64, 64, 39), -9.0, np.float32)
        presence = np.array([0.9 if self.seen else 0.1], np.float32)
        return [flat.reshape(-1), presence, mask, heat, world.reshape(-1)]


@pytest.fixture
def networks(monkeypatch):
    stand_ins = StandIns()
    monkeypatch.setattr(blazepose, '_Network', stand_ins)
    return stand_ins


IMAGE = np.full((240, 320, 3), 90, np.uint8)


def test_somebody_is_sought_once_and_then_followed(networks):
    detector = BlazePose()
    for index in range(3):
        assert detector.detect(IMAGE, INTERVAL * (index + 1)) is not None
    assert networks.asked == ['person', *['landmarks'] * 3]
    networks.seen = False
    # After a loss the person is searched in each image.
    assert [detector.detect(IMAGE, INTERVAL * (4 + i)) for i in range(3)] == [None] * 3
    assert networks.asked[4:] == ['landmarks', 'person', 'person']


def test_landmarks_are_keypoints(networks):
    detector = BlazePose(with_mask=True)
    found = detector.detect(IMAGE, INTERVAL)
    assert found is not None
    assert found.names == schemes()['mediapipe33'].names
    assert np.isnan(found.covariances).all()
    # The mean of both predictions of one person; the network sees 40 px above the image, too.
    offsets = np.array([[0.0, 40.0], [4.0, 0.0]]) / 224
    square = Square.about((_anchors()[1000] + offsets) * 320 - [0, 40])
    middle = np.array(square.centre)
    expected = square.corner + square.side * np.array([0.25, 0.75]) @ square.axes
    np.testing.assert_allclose(found.pixels[0], expected - 0.5, atol=1e-4)
    np.testing.assert_allclose(found.pixels[2:], np.tile(middle - 0.5, (31, 1)), atol=1e-4)
    np.testing.assert_allclose(found.confidences[:2], [1 / (1 + math.exp(-3)), 0.5])
    assert found.positions is not None
    # In camera axes, not in those of the square.
    np.testing.assert_allclose(
        found.positions[1], [*np.array([0.1, 0.2]) @ square.axes, 0.3], atol=1e-6
    )
    assert detector.mask is not None
    assert detector.mask[round(middle[1]) - 20, round(middle[0])]
    assert not detector.mask[round(middle[1]) + 20, round(middle[0])]
    networks.seen = False
    assert detector.detect(IMAGE, 2 * INTERVAL) is None
    assert detector.mask.shape == (240, 320)
    assert not detector.mask.any()


@pytest.mark.parametrize(
    ('stamp', 'width', 'fresh'),
    [
        (3 * INTERVAL, 320, False),
        (2 * INTERVAL, 320, True),
        (INTERVAL, 320, True),
        (2 * INTERVAL + 10**9, 320, False),
        (2 * INTERVAL + 10**9 + 1, 320, True),
        (3 * INTERVAL, 300, True),
    ],
)
def test_what_begins_a_new_sequence(networks, stamp, width, fresh):
    detector = BlazePose()
    for each in (INTERVAL, 2 * INTERVAL):
        detector.detect(IMAGE, each)
    networks.asked.clear()
    detector.detect(IMAGE[:, :width], stamp)
    assert networks.asked == ['person'] * fresh + ['landmarks']


# ---- MediaPipe Pose itself ----


def errors(found, known):
    """Differences of keypoints from rows (T, 33, 6) of MediaPipe: px, visibilities, m."""
    pixels = np.array([each.pixels for each in found]) - known[..., :2]
    positions = np.array([each.positions for each in found]) - known[..., 3:]
    visibilities = np.array([each.confidences for each in found]) - known[..., 2]
    return np.linalg.norm(pixels, axis=2), abs(visibilities), np.linalg.norm(positions, axis=2)


def test_it_finds_what_mediapipe_finds(mediapipe_pose):
    """MediaPipe 0.10.21, model 1, saw the first images of bags/reach as 30 a second."""
    with np.load(Path(__file__).parent / 'reach_mediapipe.npz') as file:
        known, packed = file['rows'].astype(float), file['mask']
    detector, found = BlazePose(with_mask=True), []
    with BagReader(ROOT / 'bags' / 'reach') as bag:
        for index, stored in zip(range(len(known)), bag.messages(['image/compressed'])):
            found.append(detector.detect(decode_image(stored.message), INTERVAL * (index + 1)))
    pixels, visibilities, positions = errors(found, known)
    assert np.median(pixels) < 0.2
    assert pixels.max() < 1.5
    assert visibilities.max() < 0.02
    assert np.median(positions) < 0.005
    assert positions.max() < 0.04
    assert detector.mask is not None
    mask = np.unpackbits(packed, axis=1)[:, : detector.mask.shape[1]].astype(bool)
    assert (mask & detector.mask).sum() / (mask | detector.mask).sum() > 0.98


def test_it_finds_what_mediapipe_finds_in_a_clip(mediapipe_pose):
    if not CLIP.is_dir():
        pytest.skip(f'no development clip in {CLIP} (set HMT_SHARED)')
    with np.load(CLIP / 'keypoints_mediapipe.npz') as file:
        columns = file['pixels'], file['visibility'][..., None], file['world']
        known = np.concatenate(columns, axis=2)[:30]
    detector, found = BlazePose(), []
    with BagReader(CLIP) as bag:
        for _, stored in zip(range(len(known)), bag.messages(['image/compressed'])):
            stamp = time_ns(stored.message.header.stamp)
            found.append(detector.detect(decode_image(stored.message), stamp))
    pixels, visibilities, positions = errors(found, known)
    assert np.median(pixels) < 0.2
    assert np.percentile(pixels, 99) < 3.0
    assert visibilities.max() < 0.05
    assert np.median(positions) < 0.005


def test_the_same_images_give_the_same_bytes(mediapipe_pose):
    with BagReader(ROOT / 'bags' / 'reach') as bag:
        stored = zip(range(4), bag.messages(['image/compressed']))
        images = [decode_image(each.message) for _, each in stored]
    runs = []
    for _ in range(2):
        detector = BlazePose()
        found = [detector.detect(image, INTERVAL * (i + 1)) for i, image in enumerate(images)]
        runs.append([each.pixels.tobytes() + each.positions.tobytes() for each in found])
    assert runs[0] == runs[1]
