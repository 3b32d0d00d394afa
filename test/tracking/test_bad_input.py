"""The tracker with bad input: odd timestamps, bad images, keypoints, masks and predictions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.viewpoint import Viewpoint
from hmt_learning.rendering.renderer import render_frames, render_people
from hmt_learning.rendering.scene import Scene
from hmt_ros.body.skeleton import other_side
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import PosePrediction, Status, Subject, Tracker, TrackerSettings

SETTINGS = TrackerSettings(
    candidates=8, max_hypotheses=4, searched_chains=1, estimate_shape=False, combinations=32
)
RATE = 10  # Hz
# First bad image, and number of good images after the bad ones for recovery.
BAD, SECOND = 8, RATE
# Number of compared images at the end of recovery, and accepted increase of errors, m.
JUDGED, MORE = 5, 0.04
NOBODY_SEEN = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))
# Segments with a shirt or shorts; others are skin, hair and shoes.
CLOTHED = ('pelvis', 'trunk', 'upper_arm', 'thigh')


class Errors(NamedTuple):
    """Mean joint errors and position errors of the pelvis in each image (T,), m."""

    heaviest: np.ndarray
    best: np.ndarray
    place: np.ndarray


@pytest.fixture(scope='module')
def film(human32, camera):
    """Poses and images of 4.4 s of a dancing person, and the empty scene."""
    view = Viewpoint(distance=3.2)
    poses = procedural_motion('dance', human32, 4.4, float(RATE), 3, viewpoint=view)
    scene = Scene(viewpoint=view, seed=2)
    frames = list(render_frames(human32, poses, camera, scene))
    empty = np.rint(scene.background(camera)).astype(np.uint8)
    return poses, frames, empty


@pytest.fixture(scope='module')
def run(film, human32, camera, keypoints_of):
    """Function (count, change, stamps, which, seed) -> errors of modes; `shown`: reliabilities.

    It tracks `count` images with their keypoints; change (i, inputs) can change the inputs.
    """
    poses, frames, empty = film

    def follow(count, change=lambda i, inputs: None, stamps=None, which=None, seed=0):
        background = BackgroundModel.from_image(empty)
        tracker = Tracker(human32, camera, SETTINGS, background, seed)
        tracker.reset(Subject(0, keypoints_of(human32, poses[0]), dict(human32.segment_lengths)))
        errors, shown = [], []
        for i in range(count):
            frame = i if which is None else which[i]
            inputs = {
                'image': frames[frame].image,
                'stamp': round(1e9 * (i / RATE if stamps is None else stamps[i])),
                'keypoints': keypoints_of(human32, poses[frame], 2.0, frame),
            }
            change(i, inputs)
            pair = tracker.step(**inputs)
            check(tracker, pair)
            errors.append(errors_of(tracker.estimate.body, pair[0], human32, poses[frame]))
            shown.append(tracker.estimate.validity.shown)
        follow.shown = shown
        return Errors(*np.array(errors).T)

    return follow


@pytest.fixture(scope='module')
def usual(run, film):
    """Errors with good input."""
    return run(len(film[0]))


def check(tracker, pair):
    for mixture in pair:
        assert mixture.weights.sum() == pytest.approx(1.0)
        for numbers in (mixture.weights, mixture.means, mixture.covariances):
            assert np.isfinite(numbers).all()
        assert np.linalg.eigvalsh(mixture.covariances).min() > 0
    assert np.isfinite(tracker.estimate.existence_probability)
    assert np.isfinite(tracker.estimate.point_estimate).all()
    assert tracker.estimate.status in (Status.TRACKING, Status.LOST)


def errors_of(body, mixture, true_body, pose):
    """Joint errors of the heaviest and of the best mode, and position errors, m."""
    joints, truth = body.joint_positions(mixture.means), true_body.joint_positions(pose[None])
    gaps = (joints - joints[:, :1]) - (truth - truth[:, :1])
    found = np.linalg.norm(gaps, axis=2).mean(1)
    return found[0], found.min(), np.linalg.norm(joints[0, 0] - truth[0, 0])


def exchanged(keypoints):
    """The keypoints with left and right swapped."""
    order = [keypoints.names.index(other_side(name)) for name in keypoints.names]
    pixels, covariances = keypoints.pixels[order], keypoints.covariances[order]
    return Keypoints(keypoints.names, pixels, covariances, keypoints.confidences[order])


@pytest.fixture(scope='module')
def alterations(film, human32, camera, keypoints_of):
    """By name: number of bad images, and a function (i, inputs) that makes input bad."""
    _, frames, empty = film
    masks, shape = [x.mask for x in frames], empty.shape
    behind = Scene(viewpoint=Viewpoint(distance=3.2), seed=2).depth(camera)
    depths = [np.minimum(x.depth, behind) for x in frames]
    noise = np.random.default_rng(0).integers(0, 256, (2 * RATE, *shape), dtype=np.uint8)
    view = Viewpoint(distance=3.2)
    scene = Scene(viewpoint=view, seed=2)
    others = procedural_motion('reach', human32, 1.0, float(RATE), 5, viewpoint=view)

    def show(picture):
        # The detector sees nothing in it, either, and gives no answer.
        return lambda i, inputs: inputs.update(image=picture(i - BAD), keypoints=None)

    def wall(i, inputs):
        clothed = np.isin(frames[i].parts, parts)
        inputs['image'] = np.where(clothed[..., None], empty, frames[i].image)

    def hide_legs(i, inputs):
        mask = masks[i].copy()
        mask[np.flatnonzero(mask.any(1)).mean().astype(int) :] = False
        inputs['mask'] = mask

    def sides(_, inputs):
        inputs['keypoints'] = exchanged(inputs['keypoints'])

    def detect_another(i, inputs):
        inputs['keypoints'] = keypoints_of(human32, others[i - BAD], 2.0, i)

    def swap_persons(i, inputs):
        inputs['image'], _ = render_people(
            [human32] * 2, [film[0][i], besides[i - BAD]], camera, scene, i
        )
        inputs['keypoints'] = keypoints_of(human32, besides[i - BAD], 2.0, i)

    def predict_another(i, inputs):
        mean, covariance = others[i - BAD], 0.02 * np.eye(human32.dimension)
        inputs['prediction'] = PosePrediction(
            GaussianMixture(np.ones(1), mean[None], covariance[None]), human32
        )

    besides = others + 1.1 * (np.arange(human32.dimension) == 0)
    names = [human32.skeleton.segment_names[part.segment] for part in human32.flesh.parts]
    parts = [i for i, name in enumerate(names) if name.endswith(CLOTHED)]
    white, black = (np.full(shape, value, np.uint8) for value in (255, 0))
    return {
        'flash': (1, show(lambda i: white)),
        'white': (RATE, show(lambda i: white)),
        'covered lens': (RATE, show(lambda i: black)),
        'noise': (RATE, show(lambda i: noise[i])),
        'wall in the colours of the clothes': (RATE, wall),
        'detector sees nobody': (RATE, lambda i, x: x.update(keypoints=NOBODY_SEEN)),
        'detector does not answer': (RATE, lambda i, x: x.update(keypoints=None)),
        'exchanged sides': (2 * RATE, sides),
        'wrong detector': (RATE, detect_another),
        'swapped persons': (RATE, swap_persons),
        'wrong prediction': (RATE, predict_another),
        'mask from left to right': (RATE, lambda i, x: x.update(mask=masks[i][:, ::-1].copy())),
        'mask from elsewhere': (RATE, lambda i, x: x.update(mask=np.roll(masks[i], 80, axis=1))),
        'mask of a second before': (RATE, lambda i, x: x.update(mask=masks[max(i - RATE, 0)])),
        'mask without legs': (RATE, hide_legs),
        'depth of another place': (RATE, lambda i, x: x.update(depth=np.full(shape[:2], 1.5))),
        'shifted depth': (RATE, lambda i, x: x.update(depth=np.roll(depths[i], 40, axis=1))),
    }


@pytest.fixture(scope='module')
def altered(run, alterations):
    """Function (name, with keypoints) -> errors in the bad images and a good second."""
    known = {}

    def follow(name, keypoints=True):
        bad, alter = alterations[name]

        def change(i, inputs):
            if not keypoints:
                inputs['keypoints'] = None
            if BAD <= i < BAD + bad:
                alter(i, inputs)

        if (name, keypoints) not in known:
            known[name, keypoints] = run(BAD + bad + SECOND, change)
            follow.shown[name, keypoints] = run.shown
        return known[name, keypoints]

    follow.shown = {}
    return follow


CASES = (
    'flash', 'white', 'covered lens', 'noise', 'wall in the colours of the clothes',
    'detector sees nobody', 'detector does not answer', 'exchanged sides', 'wrong detector',
    'swapped persons', 'wrong prediction', 'mask from left to right', 'mask from elsewhere',
    'mask of a second before', 'mask without legs', 'depth of another place', 'shifted depth',
)  # fmt: skip
WITHOUT_KEYPOINTS = (
    'flash', 'covered lens', 'noise', 'wall in the colours of the clothes', 'wrong prediction',
    'mask from left to right', 'mask without legs', 'shifted depth',
)  # fmt: skip
# With images alone, modes with the same outline may stay wrong for longer than a good second.
MAY_ERR = pytest.mark.xfail(strict=False, reason='images alone may leave the wrong pose')


@pytest.mark.parametrize('name', CASES)
def test_bad_input_leaves_numbers_and_a_person(altered, usual, name):
    """See `check`."""
    errors = altered(name).heaviest
    assert np.array_equal(errors[:BAD], usual.heaviest[:BAD])
    assert np.isfinite(errors).all()


@pytest.mark.parametrize('name', CASES)
def test_a_second_after_bad_input_the_pose_is_found_again(altered, usual, name):
    errors = altered(name).heaviest
    last = slice(len(errors) - JUDGED, len(errors))
    assert np.median(errors[last]) < usual.heaviest[last].mean() + MORE


@pytest.mark.parametrize('name', CASES)
def test_then_it_is_among_the_modes(altered, usual, name):
    """Any of the modes may be the right one."""
    errors = altered(name).best
    last = slice(len(errors) - JUDGED, len(errors))
    assert np.median(errors[last]) < np.median(usual.best[last]) + MORE


@pytest.mark.parametrize(
    'name',
    [
        # The estimated distance soon changes, and returns slowly.
        pytest.param(name, marks=MAY_ERR if name.startswith(('wall', 'mask from')) else ())
        for name in WITHOUT_KEYPOINTS
    ],
)
def test_without_keypoints_the_place_is_found_again(altered, name):
    assert np.median(altered(name, keypoints=False).place[-JUDGED:]) < 0.3


@pytest.mark.parametrize(
    ('name', 'cues'),
    [
        ('wrong detector', ['keypoints/arms']),
        # These two contradict each other.
        ('mask from elsewhere', ['silhouette', 'keypoints/trunk']),
        ('depth of another place', ['depth']),
        ('shifted depth', ['depth']),
    ],
)
def test_a_wrong_cue_is_doubted(altered, name, cues):
    errors = altered(name).heaviest
    shown = altered.shown[name, True]
    believed = np.array([min(one[cue] for cue in cues) for one in shown])
    assert believed[BAD - 1] > 0.9
    # If a pose partly explains the depth, its reliability decreases slowly.
    least = believed[BAD : len(errors) - SECOND].min()
    assert least < (0.8 if cues == ['depth'] else 0.55)
    # Only bad images have depths.
    assert cues == ['depth'] or believed[-JUDGED:].min() > 0.7


@pytest.mark.parametrize('gap', [0.1, 1000.0])
def test_gaps(run, usual, gap):
    """Over three seeds, because a track may get a limb wrong."""
    count = BAD + SECOND
    stamps = [i / RATE + (gap if i >= BAD else 0.0) for i in range(count)]
    errors = [run(count, stamps=stamps, seed=seed).heaviest for seed in range(3)]
    known = usual.heaviest
    assert np.array_equal(errors[0][:BAD], known[:BAD])
    late = np.median([one[-JUDGED:].mean() for one in errors])
    assert late < known[count - JUDGED : count].mean() + MORE


@pytest.fixture(scope='module')
def slowed(run, film):
    """Image indices, with a third of the rate from the middle on, and errors.

    Over five seeds, because a track may lose a limb that moves far between images.
    """
    which = [*range(BAD), *range(BAD, len(film[0]), 3)]
    stamps = [i / RATE for i in which]
    found = [run(len(which), stamps=stamps, which=which, seed=seed) for seed in range(5)]
    return which, [one.heaviest for one in found]


def test_a_rate_that_falls_in_the_middle(slowed, usual):
    which, (errors, *_) = slowed
    assert np.array_equal(errors[:BAD], usual.heaviest[:BAD])
    early = BAD + 4
    assert errors[BAD:early].mean() < usual.heaviest[which[BAD:early]].mean() + MORE


def test_at_the_lower_rate_the_pose_stays_known(slowed, usual):
    """A dancing person moves far in 0.3 s."""
    which, errors = slowed
    late = np.median([one[-JUDGED:].mean() for one in errors])
    assert late < usual.heaviest[which[-JUDGED:]].mean() + 1.5 * MORE


def test_stamps_that_do_not_increase_are_refused_and_change_nothing(
    film, human32, camera, keypoints_of
):
    poses, frames, empty = film
    found = []
    for disturbed in (False, True):
        tracker = Tracker(human32, camera, SETTINGS, BackgroundModel.from_image(empty))
        tracker.reset(Subject(0, keypoints_of(human32, poses[0]), dict(human32.segment_lengths)))
        pairs = []
        for i in range(5):
            seen, stamp = keypoints_of(human32, poses[i], 2.0, i), i * 100_000_000
            pairs.append(tracker.step(frames[i].image, stamp, seen))
            check(tracker, pairs[-1])
            if disturbed:
                for late in (stamp, stamp - 1, 0, -1):
                    with pytest.raises(ValueError, match=f'stamps must increase, saw {late} after'):
                        tracker.step(frames[i + 1].image, late, exchanged(seen))
        found.append(pairs)
    one, other = (
        [x.tobytes() for pair in pairs for m in pair for x in (m.weights, m.means, m.covariances)]
        for pairs in found
    )
    assert one == other


def test_names_of_a_detector_are_refused_before_anything_changes(human32, camera):
    tracker = Tracker(human32, camera, SETTINGS)
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    pixels = np.full((2, 2), 50.0)
    found = Keypoints(('nose', 'left_wrist'), pixels, np.stack([np.eye(2)] * 2), np.ones(2))
    with pytest.raises(ValueError, match=r"no joints \['nose'\]; use Keypoints.named_for"):
        tracker.step(image, 0, found)
    tracker.step(image, 0, found.named_for(human32)[0])
