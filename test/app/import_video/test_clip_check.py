"""The check of a clip: confidences, sizes and point orders not stated in the file."""

import json

import numpy as np
import pytest

from hmt_learning.training.training_set import procedural_sequence
from hmt_ros.app.import_video.frames import FrameSource
from hmt_ros.app.import_video.keypoint_files.choice import Choice
from hmt_ros.app.import_video.keypoint_files.reading import (
    ClipReading,
    keypoints_of_person,
    mirrored,
    read_keypoints,
)
from hmt_ros.body import Camera, load_body
from hmt_ros.body.kinematics import forward
from hmt_ros.image.keypoint_schemes import schemes

BODY = load_body('human37')
CAMERA = Camera(554.256, 554.256, 319.5, 239.5, 640, 480)
SIZE = (640, 480)


class Numbered(FrameSource):
    """Frames that have numbers."""

    def frames(self, selection):
        return iter(())


def walker(scheme, count=30, away=0.0):
    """(T, n, 3) columns, rows and confidences of a person who walks and turns."""
    poses = procedural_sequence('walk', BODY, 3.0, 0).poses[::3][:count].copy()
    poses[:, :3] = 0.3 + away, 0.0, 4.0
    skeleton, marks = BODY.skeleton, schemes()[scheme].landmarks
    which = skeleton.joint_index(tuple(x.joint or 'head' for x in marks))
    offsets = skeleton.joint_offsets[which] + np.array([x.offset for x in marks])
    places = forward(skeleton, poses).points(skeleton.joint_segments[which], offsets)
    pixels = CAMERA.project(places.transpose(2, 0, 1).reshape(-1, 3)).reshape(count, -1, 2)
    pixels[:, [not x.joint for x in marks]] = 0.0  # not seen
    sure = np.linspace(0.6, 1.0, len(marks)) * np.ones((count, 1))
    return np.concatenate([pixels, sure[..., None]], axis=2)


def read(path, points, **reading):
    """Keypoints of the person by frame, and the messages, from points (T, n, 3)."""
    entries = [{'image_id': t, 'keypoints': x.ravel().tolist()} for t, x in enumerate(points)]
    path = path / 'walk.json'
    path.write_text(json.dumps(entries), 'utf-8')
    found = read_keypoints(path, Numbered(path), 0)
    told = []
    chosen = keypoints_of_person(found, ClipReading(**reading), SIZE, told.append)
    return chosen, ' '.join(told)


def test_what_is_right_stays(tmp_path):
    for scheme in ('coco17', 'body25', 'halpe26', 'mediapipe33', 'skeleton2d'):
        points = walker(scheme)
        chosen, told = read(tmp_path, points)
        assert told == ''
        assert chosen[3].names == schemes()[scheme].names
        seen = chosen[3].seen
        assert seen.sum() >= 14
        assert np.array_equal(chosen[3].pixels[seen], points[3, seen, :2])
        assert np.array_equal(chosen[3].confidences[seen], points[3, seen, 2])


@pytest.mark.parametrize(('scheme', 'usual'), [('body25b', 'body25'), ('h36m17', 'coco17')])
def test_bones_tell_the_order(scheme, usual, tmp_path):
    points = walker(scheme)
    chosen, told = read(tmp_path, points)
    assert chosen[0].names == schemes()[scheme].names
    assert f'in the order of {scheme}, not in that of {usual}; --scheme {usual}' in told
    # A given order is used.
    assert read(tmp_path, points, scheme=usual)[0][0].names == schemes()[usual].names


def test_points_in_no_order_are_refused(tmp_path):
    points = walker('coco17')[:, np.random.default_rng(1).permutation(17)]
    with pytest.raises(
        ValueError, match=r'17 points are not in the order of coco17 .* --scheme coco17 '
    ):
        read(tmp_path, points)
    assert len(read(tmp_path, points, scheme='coco17')[0]) == 30
    # Few images are not enough.
    assert len(read(tmp_path, points[:9])[0]) == 9


@pytest.mark.parametrize('scheme', ['coco17', 'body25', 'halpe26'])
@pytest.mark.parametrize('hidden', [('ankle', 'heel', 'toe'), ('knee', 'ankle', 'heel', 'toe')])
def test_half_a_person_keeps_the_usual_order(scheme, hidden, tmp_path):
    points = walker(scheme)
    names = schemes()[scheme].names
    points[:, [any(x in name for x in hidden) for name in names]] = 0.0
    chosen, told = read(tmp_path, points)
    assert told == ''
    assert chosen[0].names == names


def test_two_people_in_one_list(tmp_path):
    """Legs of one person and the rest of another, or both people alternately."""
    one, other = walker('coco17'), walker('coco17', away=-0.9)
    mixed = one.copy()
    mixed[:, 11:] = other[:, 11:]
    with pytest.raises(ValueError, match='points of two people are in one list'):
        read(tmp_path, mixed)
    turns = np.where(np.random.default_rng(0).random((30, 1, 1)) < 0.5, one, other)
    with pytest.raises(ValueError, match='points of two people under one name'):
        read(tmp_path, turns, person=Choice.parse('index:0'))


@pytest.mark.parametrize(('scale', 'said'), [(100, 'parts of 100'), (255, 'parts of 255')])
def test_percent(scale, said, tmp_path):
    points = walker('coco17')
    chosen, told = read(tmp_path, points * (1, 1, scale))
    assert said in told
    assert chosen[0].confidences[5:] == pytest.approx(points[0, 5:, 2])


def test_points_of_smaller_images(tmp_path):
    points = walker('coco17')
    half = points * (0.5, 0.5, 1)
    with pytest.raises(ValueError, match=r'upper left quarter .* --keypoints-size WxH .* 320x240'):
        read(tmp_path, half)
    chosen, told = read(tmp_path, half, points_size=(320, 240))
    assert 'scaled from 320x240 to 640x480' in told
    np.testing.assert_allclose(chosen[0].pixels[5:], points[0, 5:, :2])
    kept, _ = read(tmp_path, half, points_size=SIZE)
    assert np.array_equal(kept[0].pixels[5:], half[0, 5:, :2])
    with pytest.raises(
        ValueError, match='in images of 300x300 pixels, but the frames have 640x480'
    ):
        read(tmp_path, points, points_size=(300, 300))
    with pytest.raises(ValueError, match=r'lie outside of the images, .* --keypoints-size WxH'):
        read(tmp_path, points * (2, 2, 1))
    # Feet guessed below the image have no effect.
    points[:, 13:, 1:] = 600.0, 0.1
    assert read(tmp_path, points)[1] == ''


def test_fractions(tmp_path):
    points = walker('coco17')
    for fractions in (points / (640, 480, 1), (points - (320, 240, 0)) / (320, 320, 1)):
        chosen, told = read(tmp_path, fractions)
        assert 'fractions of the image, of 640x480' in told
        np.testing.assert_allclose(chosen[0].pixels[5:], points[0, 5:, :2])


def test_mirror_images(tmp_path):
    """In a mirror image left is right; mirroring twice is the identity."""
    points = walker('coco17')
    plain, _ = read(tmp_path, points)
    chosen, _ = read(tmp_path, points, mirror=True)
    left, right = (schemes()['coco17'].names.index(f'{x}_wrist') for x in ('left', 'right'))
    assert chosen[0].names[left] == 'right_wrist'
    assert chosen[0].pixels[left] == pytest.approx((639 - points[0, left, 0], points[0, left, 1]))
    again = mirrored(chosen[0], 640)
    assert again.names == plain[0].names
    np.testing.assert_allclose(again.pixels, plain[0].pixels)
    assert chosen[0].names[right] == 'left_wrist'
