"""Existence probability: single cues at known poses, and an oracle."""

from __future__ import annotations

import math
from datetime import datetime, timedelta, timezone

import numpy as np
import pytest

from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.markov_chain import update
from hmt_ros.tracking.existence import (
    EXISTENCE_CHAIN,
    GIVEN_PROBABILITY,
    Existence,
)
from hmt_ros.tracking.observer import View
from hmt_ros.tracking.settings import ABSENT_PROBABILITY, PRESENT_PROBABILITY

SECOND = 1_000_000_000
NO_KEYPOINTS = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))


# The recursion.


def test_without_an_image_nobody_is_not_said():
    """For any duration, r stays far above the limit."""
    for dt in (1.0, 1e3, 1e9):
        assert (
            EXISTENCE_CHAIN.predict([1 - GIVEN_PROBABILITY, GIVEN_PROBABILITY], dt)[1]
            > 5 * ABSENT_PROBABILITY
        )


def test_against_the_bernoulli_filter_of_stone_soup():
    """At a constant rate, with a measurement at the person in some scans only."""
    pytest.importorskip('stonesoup')
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.predictor.particle import BernoulliParticlePredictor
    from stonesoup.types.array import StateVectors
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.multihypothesis import MultipleHypothesis
    from stonesoup.types.prediction import BernoulliParticleStatePrediction
    from stonesoup.updater.particle import BernoulliParticleUpdater

    dt, detected, clutter = 0.2, 0.9, 0.05
    predictor = BernoulliParticlePredictor(
        transition_model=None,
        birth_probability=EXISTENCE_CHAIN.transition(dt)[0, 1],
        survival_probability=EXISTENCE_CHAIN.transition(dt)[1, 1],
    )
    model = LinearGaussian(1, [0], np.array([[1.0]]))
    updater = BernoulliParticleUpdater(
        model, clutter_rate=1, clutter_distribution=clutter, detection_probability=detected
    )
    theirs, ours = 0.3, np.array([0.7, 0.3])
    for step, at in enumerate([0.1, 0.0, 5.0, 50.0, 50.0, -0.3, 1.0, 50.0]):
        ours = EXISTENCE_CHAIN.predict(ours, dt)
        theirs = predictor.estimate_existence(theirs)
        time = datetime(2020, 1, 1, tzinfo=timezone.utc) + timedelta(seconds=step * dt)
        # The particles are at the person's position.
        state = BernoulliParticleStatePrediction(
            StateVectors(np.zeros((1, 4))), log_weight=np.full(4, math.log(0.25)),
            existence_probability=theirs, timestamp=time,
        )  # fmt: skip
        detection = Detection([at], measurement_model=model, timestamp=time)
        found = updater.update(MultipleHypothesis([SingleHypothesis(state, detection)]))
        theirs = float(found.existence_probability)
        density = math.exp(-0.5 * at**2) / math.sqrt(2 * math.pi)
        ours = update(ours, [0.0, math.log(1 - detected + detected * density / clutter)])
        assert ours[1] == pytest.approx(theirs, rel=1e-9)
        assert 0.01 < ours[1] < 0.999


# The cues.


@pytest.fixture(scope='module')
def film(filmed, camera, human32):
    """Poses, images and silhouettes of a second, and the empty scene."""
    poses, images, empty = filmed('reach', 1.0, camera)
    return poses, images, render_silhouettes(human32, poses, camera), empty


@pytest.fixture(scope='module')
def watched(film, human32, camera):
    """Function (views, rate) -> probabilities, detections, and the updated existence."""

    def watch(views, rate=10.0, pose_of=lambda pose, _: pose, watching=None, first=0):
        if watching is None:
            watching = Existence(GIVEN_PROBABILITY)
            stamp = round(first * SECOND / rate)
            watching.appearance.learn(views[0], stamp, human32, camera, film[0][first])
        found = []
        for i, view in enumerate(views, first):
            stamp = round(i * SECOND / rate)
            watching.update(view._replace(stamp=stamp), human32)
            if watching.last.seen:
                pose = pose_of(film[0][i % len(film[0])], i)
                watching.appearance.learn(view, stamp, human32, camera, pose)
            found.append((watching.probability, watching.last.seen))
        return np.array([x for x, _ in found]), [x for _, x in found], watching

    return watch


def view_of(image, mask, **fields):
    changed = fields.pop('changed', mask.mean())
    return View(image, silhouette=mask, anywhere=mask, changed=changed, **fields)


def full_views(film, count=6, **fields):
    _, images, masks, _ = film
    return [view_of(images[i % 10], masks[i % 10], **fields) for i in range(count)]


def empty_views(film, count, **fields):
    nothing = np.zeros(film[3].shape[:2], dtype=np.bool_)
    return [view_of(film[3], nothing, **fields) for _ in range(count)]


@pytest.mark.parametrize('rate', [30.0, 10.0, 7.0, 5.0])
def test_an_empty_scene_ends_it_within_half_a_second(film, watched, rate):
    found, seen, watching = watched(full_views(film), rate)
    assert all(seen)
    assert found.min() > 0.99
    found, seen, watching = watched(empty_views(film, 20), rate, watching=watching, first=6)
    assert not any(seen)
    assert watching.nobody
    # After the last image of the person, which precedes the first of these.
    assert 0.3 <= (1 + np.argmax(found < ABSENT_PROBABILITY)) / rate <= 0.5
    # A new person is detected within 0.3 s.
    found, seen, _ = watched(full_views(film, 10), rate, watching=watching, first=26)
    assert 0.1 <= np.argmax(found > PRESENT_PROBABILITY) / rate <= 0.34


def test_a_wrong_pose_is_not_an_absent_person(film, watched):
    """The silhouette has the usual size, but beside the model: the track must search."""

    def aside(pose, i):
        return pose if i < 6 else pose + 0.9 * (np.arange(len(pose)) == 0)

    found, seen, watching = watched(full_views(film, 7), pose_of=aside)
    assert not watching.last.elsewhere
    found, seen, watching = watched(full_views(film, 4), pose_of=aside, watching=watching, first=7)
    assert all(seen)
    assert found.min() > PRESENT_PROBABILITY
    assert watching.last.elsewhere
    remnant = [
        view_of(view.image, view.silhouette & (np.arange(240) > 205)[:, None])
        for view in full_views(film, 3)
    ]
    found, *_ = watched(remnant, watching=watching, first=11)
    assert watching.last.llr < 0


@pytest.mark.parametrize('kind', ['black', 'noise', 'white'])
@pytest.mark.parametrize('background', [True, False])
def test_images_that_show_nothing_say_nothing(film, watched, kind, background):
    shape = film[3].shape
    image = {
        'black': np.zeros(shape, np.uint8),
        'white': np.full(shape, 255, np.uint8),
        'noise': np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8),
    }[kind]
    everything = np.ones(shape[:2], dtype=np.bool_)
    before = full_views(film)
    view = view_of(image, everything, changed=1.0)
    if not background:
        before, view = [View(x.image) for x in before], View(image)
    _, _, watching = watched(before)
    r = watching.probability
    found, *_ = watched([view] * 3, watching=watching, first=6)
    assert watching.last.llr == 0.0
    assert found[-1] == pytest.approx(EXISTENCE_CHAIN.predict([1 - r, r], 0.3)[1], abs=1e-9)


def test_colours_are_asked_where_the_background_is_of_no_use(film, watched):
    """The camera was pushed: everything is foreground, the person is still present."""
    _, images, _, empty = film
    everything = np.ones(empty.shape[:2], dtype=np.bool_)
    _, _, watching = watched(full_views(film))
    pushed = [view_of(images[i], everything, changed=1.0) for i in (6, 7)]
    _, seen, _ = watched(pushed, watching=watching, first=6)
    assert seen == [True] * 2
    # Then colours are no evidence against the person.
    watched([view_of(empty, everything, changed=1.0)] * 3, watching=watching, first=8)
    assert watching.last.llr == 0.0


def test_colours_decide_where_there_is_no_background(film, watched):
    _, images, _, empty = film
    found, seen, watching = watched([View(image) for image in images[:8]])
    assert seen == [True] * 8
    assert found.min() > PRESENT_PROBABILITY
    found, seen, _ = watched([View(empty)] * 20, watching=watching, first=8)
    assert not any(seen)
    assert watching.nobody
    assert 0.4 < 0.1 * (1 + np.argmax(found < ABSENT_PROBABILITY)) < 2.0


@pytest.mark.parametrize('rate', [10.0, 5.0, 2.7])
def test_a_thing_that_was_taken_for_somebody_leaves_the_image(film, watched, rate):
    """A track is on an object and the camera turns; the person is in view as before."""
    _, images, _, _ = film

    def aside(pose, _=0):
        return pose - 0.9 * (np.arange(len(pose)) == 0)

    def with_a_thing(image):
        result = image.copy()
        result[60:, 40:115] = 20, 110, 230
        return result

    before = [View(with_a_thing(image)) for image in images]
    _, _, watching = watched(before, rate, pose_of=aside)
    _, seen, _ = watched(before, rate, pose_of=aside, watching=watching, first=len(before))
    assert all(seen)
    turned = [View(np.roll(image, 60, axis=1)) for image in images]
    found, seen, _ = watched(turned * 3, rate, watching=watching, first=2 * len(before))
    assert not any(seen)  # the appearance differs from the learned one
    assert not watching.somebody
    assert found.min() > 5 * ABSENT_PROBABILITY


def keypoints(count, confidence, at=(100.0, 100.0)):
    return Keypoints(
        tuple(f'joint_{i}' for i in range(count)),
        np.tile(at, (count, 1)),
        np.tile(np.eye(2), (count, 1, 1)),
        np.full(count, confidence),
    )


@pytest.mark.parametrize('fields', [{'keypoints': NO_KEYPOINTS}, {'predicted': False}])
def test_a_detector_alone_can_end_a_track(film, watched, fields):
    grey = np.full(film[3].shape, 90, np.uint8)
    for rate in (30.0, 10.0, 5.0):
        found, seen, watching = watched([View(grey)] * 2, rate)
        views = [View(grey, **fields)] * 40
        found, seen, _ = watched(views, rate, watching=watching, first=2)
        assert not any(seen)
        assert 0.5 <= (1 + np.argmax(found < ABSENT_PROBABILITY)) / rate <= 1.1


def test_keypoints_far_from_the_model_are_somebody_elsewhere(film, watched):
    grey = np.full(film[3].shape, 90, np.uint8)
    _, _, watching = watched([View(grey)] * 2)
    watched([View(grey, keypoints=keypoints(12, 0.9, (160.0, 120.0)))], watching=watching, first=2)
    assert not watching.last.elsewhere
    # Nobody walks 1.2 m in 0.1 s.
    far = [View(grey, keypoints=keypoints(12, 0.9, (10.0, 120.0)))]
    watched(far, watching=watching, first=3)
    assert not watching.last.elsewhere
    watched(far, watching=watching, first=13)
    assert watching.last.elsewhere


@pytest.mark.parametrize('hidden', [0.6, 1.0])
def test_who_is_hidden_has_not_left(film, watched, hidden):
    """Another person is in front; no cue is used during the occlusion."""
    others = np.zeros(film[3].shape[:2], dtype=np.bool_)
    _, _, watching = watched(full_views(film))
    rows = np.flatnonzero(film[2][5].any(1))
    others[: round(rows[0] + hidden * (rows[-1] - rows[0])) + 1] = True
    views = empty_views(film, 50, keypoints=NO_KEYPOINTS, others=others)
    found, *_ = watched(views, watching=watching, first=6)
    assert watching.last.hidden
    assert watching.last.llr == 0.0
    assert not watching.nobody
    assert np.all(np.diff(found) < 0)
    assert found[-1] > 0.3


# Static objects.


@pytest.mark.parametrize('waiting', [False, True])
def test_a_detector_says_the_same_of_the_same_picture(waiting, human37, camera, keypoints_of):
    """Before a track, keypoints on a static object count only once, because people move."""
    rng = np.random.default_rng(0)
    thing = rng.integers(0, 255, (camera.height, camera.width, 3), dtype=np.uint8)
    pose = human37.prior_mean.copy()
    pose[:3] = 0.0, 0.2, 4.0
    seen = keypoints_of(human37, pose)

    def probability(images) -> float:
        existence = Existence()
        for i, image in enumerate(images):
            noisy = np.clip(image + rng.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8)
            view = View(noisy, keypoints=seen, stamp=i * SECOND // 10)
            existence.update(view, human37, waiting=waiting)
        return existence.probability

    still = probability(20 * [thing])
    moving = probability([np.roll(thing, 3 * i, axis=1) for i in range(20)])
    blank = probability(20 * [np.zeros_like(thing)])
    assert moving > PRESENT_PROBABILITY
    assert blank > PRESENT_PROBABILITY
    assert (still > PRESENT_PROBABILITY) != waiting


# Without any other cue.


def bare_views(film, indices):
    return [View(film[1][i]) for i in indices]


def test_a_person_who_moves_is_there(film, watched):
    """Motion is the only evidence; without it the probability would be 2/3 after two seconds."""
    found, seen, watching = watched(bare_views(film, range(10)), 5.0)
    assert all(seen)
    assert found.min() > 0.95
    assert 'motion' in watching.last.log_ratios
