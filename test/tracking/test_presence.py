"""Cues for whether a person is in view, one by one, on rendered images at known poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.rendering.renderer import render_silhouettes
from hmt_ros.tracking.presence import (
    Presence,
    View,
    covered,
    histogram,
    looks_like_person,
    sees_person,
    surroundings,
)

SECOND = 1_000_000_000
NOBODY = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))


@pytest.fixture(scope='module')
def film(filmed, camera, human32):
    """Poses, images and silhouettes of a second, and the empty scene."""
    poses, images, empty = filmed('reach', 1.0, camera)
    return poses, images, render_silhouettes(human32, poses, camera), empty


@pytest.fixture(scope='module')
def watched(film, human32, camera):
    """Function (view of image i, pose of image i) -> whether each was seen, and who watched."""

    def watch(views, rate=10.0, pose_of=lambda pose, _: pose, presence=None, first=0):
        presence = presence or Presence(0.5)
        seen = []
        for i, view in enumerate(views, first):
            pose = pose_of(film[0][i % len(film[0])], i)
            stamp = round(i * SECOND / rate)
            seen.append((presence.sees(view, stamp, human32, camera, pose), presence.absent))
        return [x for x, _ in seen], [x for _, x in seen], presence

    return watch


def full_views(film, count=6, **fields):
    _, images, masks, _ = film
    return [View(images[i], masks[i], masks[i].mean(), **fields) for i in range(count)]


def empty_views(film, count, **fields):
    empty = film[3]
    nothing = np.zeros(empty.shape[:2], dtype=np.bool_)
    return [View(empty, nothing, 0.0, **fields) for _ in range(count)]


def test_the_model_covers_what_it_shows(film, human32, camera):
    poses, _, masks, _ = film
    for pose, mask in zip(poses[:3], masks[:3], strict=True):
        found = covered(human32, camera, pose)
        assert (found & mask).sum() / (found | mask).sum() > 0.93
        coarse = covered(human32, camera, pose, 3)
        assert coarse.shape == (80, 107)
        assert coarse.mean() == pytest.approx(mask.mean(), rel=0.2)


def test_a_body_out_of_the_image_covers_nothing(film, human32, camera):
    pose = film[0][0].copy()
    for axis, shift in ((0, 30.0), (2, -30.0)):
        moved = pose.copy()
        moved[axis] += shift
        assert not covered(human32, camera, moved).any()


def test_surroundings_are_near_and_not_the_model():
    model = np.zeros((60, 80), dtype=np.bool_)
    model[20:40, 30:40] = True
    around = surroundings(model)
    assert not (around & model).any()
    assert around[20, 22]
    assert not around[20, 28]  # a margin, for the clothes
    rows, columns = np.nonzero(around)
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (10, 49, 20, 49)


def test_histograms_are_shares_of_colours():
    image = np.zeros((2, 4, 3), dtype=np.uint8)
    image[0, 1:] = (10, 100, 250)
    where = np.ones((2, 4), dtype=np.bool_)
    where[1] = False
    found = histogram(image, where)
    assert found[0] == 0.25
    assert found[(0 << 6) + (3 << 3) + 7] == 0.75
    assert found.sum() == 1.0
    assert histogram(image, np.zeros((2, 4), dtype=np.bool_)).sum() == 0.0


@pytest.mark.parametrize('rate', [30.0, 10.0, 7.0])
def test_an_empty_scene_ends_it_within_half_a_second(film, watched, rate):
    seen, absent, presence = watched(full_views(film), rate)
    assert seen == [True] * 6
    assert not any(absent)
    seen, absent, _ = watched(empty_views(film, 20), rate, presence=presence, first=6)
    assert not any(seen)
    # After the last image of the person, which is before the first empty one.
    assert absent.index(True) == np.ceil(0.5 * rate) - 1
    # The time counts anew when the person has been there.
    watched(full_views(film, 1), rate, presence=presence, first=26)
    assert not presence.absent


def test_one_image_is_not_enough_however_late_it_comes(film, watched):
    _, _, presence = watched(full_views(film), 1.0)
    _, absent, _ = watched(empty_views(film, 2), 1.0, presence=presence, first=6)
    assert absent == [False, True]


def test_an_empty_scene_from_the_start(film, watched):
    _, absent, _ = watched(empty_views(film, 7))
    assert absent == [False] * 5 + [True] * 2


@pytest.mark.parametrize('share', [0.36, 0.2])
def test_clothes_in_the_colours_of_the_room(film, watched, share):
    """Most of the person is missing in the silhouette, as usual for this one."""
    rng = np.random.default_rng(0)
    views = [
        view._replace(silhouette=view.silhouette & (rng.random(view.silhouette.shape) < share))
        for view in full_views(film, 10)
    ]
    seen, _, presence = watched(views)
    assert all(seen)
    seen, _, _ = watched(empty_views(film, 3), presence=presence, first=10)
    assert not any(seen)


def test_a_wrong_pose_is_not_an_absent_person(film, watched):
    """The silhouette is as large as usual, beside the model; a remnant is no person."""

    def aside(pose, i):
        return pose if i < 6 else pose + 0.9 * (np.arange(len(pose)) == 0)

    views = full_views(film, 10)
    views += [
        view._replace(silhouette=view.silhouette & (np.arange(240) > 190)[:, None])
        for view in full_views(film, 3)
    ]
    seen, _, _ = watched(views, pose_of=aside)
    assert seen == [True] * 10 + [False] * 3


@pytest.mark.parametrize('kind', ['black', 'noise', 'white'])
def test_images_that_show_nothing(film, watched, kind):
    """All of the image differs from the background; without one the colours are strange."""
    shape = film[3].shape
    image = {
        'black': np.zeros(shape, np.uint8),
        'white': np.full(shape, 255, np.uint8),
        'noise': np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8),
    }[kind]
    everything = np.ones(shape[:2], dtype=np.bool_)
    for before, view in (
        (full_views(film), View(image, everything, 1.0)),
        ([View(view.image) for view in full_views(film)], View(image)),
    ):
        _, _, presence = watched(before)
        seen, _, _ = watched([view] * 3, presence=presence, first=6)
        assert not any(seen)


def test_colours_decide_where_the_background_is_of_no_use(film, watched):
    """The camera was pushed: everything is foreground, the person is still there."""
    _, images, _, empty = film
    everything = np.ones(empty.shape[:2], dtype=np.bool_)
    _, _, presence = watched(full_views(film))
    seen, _, _ = watched(
        [View(images[6], everything, 1.0), View(images[7], everything, 1.0)],
        presence=presence, first=6,
    )  # fmt: skip
    assert seen == [True] * 2
    seen, _, _ = watched([View(empty, everything, 1.0)] * 3, presence=presence, first=8)
    assert seen == [False] * 3


def test_colours_decide_where_there_is_no_background(film, watched):
    _, images, _, empty = film
    seen, _, presence = watched([View(image) for image in images[:8]])
    assert seen == [True] * 8
    seen, absent, _ = watched([View(empty)] * 6, presence=presence, first=8)
    assert seen == [False] * 6
    assert absent == [False] * 4 + [True] * 2


def test_colours_that_are_the_same_everywhere_say_nothing(film, watched):
    grey = np.full(film[3].shape, 90, np.uint8)
    seen, _, _ = watched([View(grey)] * 20)
    assert all(seen)


def keypoints(count, confidence):
    return Keypoints(
        tuple(f'joint_{i}' for i in range(count)),
        np.full((count, 2), 100.0),
        np.tile(np.eye(2), (count, 1, 1)),
        np.full(count, confidence),
    )


@pytest.mark.parametrize(
    ('seen', 'wanted'),
    [
        (None, None),
        (NOBODY, False),
        (replace(keypoints(12, 1.0), pixels=np.full((12, 2), np.nan)), False),
        (keypoints(12, 0.0), False),
        (keypoints(12, 0.9), True),
        (keypoints(12, 0.2), None),
        (keypoints(4, 1.0), None),
    ],
)
def test_keypoints(seen, wanted):
    assert sees_person(seen) is wanted


def test_a_failed_detector_does_not_end_a_track_with_a_silhouette(film, watched):
    seen, _, _ = watched(full_views(film, keypoints=NOBODY, nobody_predicted=True))
    assert all(seen)


def test_keypoints_of_a_person_keep_a_track_without_silhouette(film, watched):
    seen, _, _ = watched(empty_views(film, 6, keypoints=keypoints(12, 0.9)))
    assert all(seen)


@pytest.mark.parametrize('fields', [{'keypoints': NOBODY}, {'nobody_predicted': True}])
def test_a_detector_alone_can_end_a_track(film, watched, fields):
    grey = np.full(film[3].shape, 90, np.uint8)
    seen, absent, _ = watched([View(grey), *[View(grey, **fields)] * 6])
    assert seen == [True] + [False] * 6
    assert absent == [False] * 5 + [True] * 2


def test_a_body_that_leaves_the_image(film, watched):
    grey = np.full(film[3].shape, 90, np.uint8)

    def leaving(pose, i):
        return pose + 0.5 * i * (np.arange(len(pose)) == 0)

    seen, _, _ = watched([View(grey)] * 10, pose_of=leaving)
    # The image is 3.4 m wide there.
    assert seen == [True] * 4 + [False] * 6 or seen == [True] * 5 + [False] * 5


def test_shapes_of_persons(film):
    masks = film[2]
    assert all(looks_like_person(mask) for mask in masks)
    box = np.zeros((240, 320), dtype=np.bool_)
    assert not looks_like_person(box)
    box[40:200, 100:200] = True
    assert not looks_like_person(box)
    line = np.zeros((240, 320), dtype=np.bool_)
    line[40:200, 100:103] = True
    assert not looks_like_person(line)
    small = np.zeros((240, 320), dtype=np.bool_)
    small[40:80, 100:140] = masks[0][60:100, 140:180]
    assert not looks_like_person(small & (np.arange(240) < 70)[:, None])


def test_who_is_hidden_has_not_left_for_a_while(film, watched):
    """Somebody else stands before the person; no cue counts, for three seconds."""
    everything = np.ones(film[3].shape[:2], dtype=np.bool_)
    seen, absent, presence = watched(full_views(film))
    assert seen == [True] * 6
    assert not presence.hidden
    hidden = empty_views(film, 30, keypoints=NOBODY, others=everything)
    seen, absent, _ = watched(hidden, presence=presence, first=6)
    assert seen == [True] * 30
    assert presence.hidden
    assert not any(absent)
    seen, absent, _ = watched(hidden[:8], presence=presence, first=36)
    # Of which the first may still be within three seconds; half a second later nobody is there.
    assert seen[1:] == [False] * 7
    assert absent[-1]


def test_a_part_that_others_hide_is_not_missed(film, watched):
    """Half of the model is hidden: the share of the rest counts."""
    views, others = full_views(film, 10), np.zeros(film[3].shape[:2], dtype=np.bool_)
    others[:130] = True
    part = [view._replace(silhouette=view.silhouette & ~others, others=others) for view in views]
    seen, _, presence = watched(part)
    assert seen == [True] * 10
    assert not presence.hidden
