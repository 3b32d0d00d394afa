"""States along motions, compared with dense algebra, and refused input."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np
import pytest
from scipy.special import logsumexp

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.inference.mode_chain import backward_weights
from hmt_ros.smoothing import LinearGaussianDynamics, MotionSmoother, SlidingWindow, motion_smoother
from hmt_ros.smoothing.motion_smoother import FirstStates, Past
from hmt_ros.smoothing.trajectory_mixture import weights_capped_by_first

FAST = LinearGaussianDynamics.constant_velocity([2.0, 1.0], 0.8)
UNEVEN = np.cumsum([0.0, 0.1, 0.05, 0.4, 0.1])
STAMPS = [round(1e9 * t) for t in UNEVEN]
LASTING = CueErrors(0.4, 0.2)


def as_points(poses):
    return poses[..., None]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.mark.parametrize('moving', [True, False])
def test_one_mode_at_each_time_is_a_kalman_smoother(modes, walk, chained, dense, moving):
    dynamics = FAST if moving else walk
    mixtures = [mixture[:1].normalised() for mixture in modes(1.0)]
    found = MotionSmoother(dynamics).smooth(chained(mixtures, STAMPS))
    mean, covariance = dense(mixtures, [0] * 5, dynamics, np.diff(UNEVEN))
    np.testing.assert_allclose(found.states, mean[None], atol=1e-9)
    for t in range(5):
        marginal = found.marginal(t)
        np.testing.assert_allclose(marginal.covariances[0], covariance[t, :2, t, :2], atol=1e-9)
    assert found.weights.tolist() == [1.0]
    assert found.stamps_ns == tuple(STAMPS)


def test_errors_that_last_count_once(modes, chained, dense):
    """Covariances S / b in the smoother, and the factor for constant errors on the output."""
    mixtures = [mixture[:1].normalised() for mixture in modes(1.0)]
    found = MotionSmoother(FAST).smooth(chained(mixtures, STAMPS, errors=LASTING))
    intervals = [np.inf, *np.diff(UNEVEN)]
    counted = [
        GaussianMixture(one.weights, one.means, one.covariances / LASTING.of_changes(dt))
        for one, dt in zip(mixtures, intervals, strict=True)
    ]
    mean, covariance = dense(counted, [0] * 5, FAST, np.diff(UNEVEN))
    np.testing.assert_allclose(found.states, mean[None], atol=1e-9)
    wider = np.mean([LASTING.persistence_ratio(dt) for dt in intervals])
    np.testing.assert_allclose(
        found.marginal(2).covariances[0], wider * covariance[2, :2, 2, :2], rtol=1e-8
    )


def test_modes_of_one_motion_are_one_gaussian_that_contains_them(chained, dense):
    """Two modes 10 mm apart: their mean is smoothed, marginals include their difference."""
    walk = LinearGaussianDynamics.random_walk([0.01])
    spread = 1e-6
    mixtures = [GaussianMixture([0.5, 0.5], [[0.0], [0.01]], [[[spread]]] * 2)] * 9
    smoother = MotionSmoother(walk, points=as_points)
    found = smoother.smooth(chained(mixtures, [round(1e9 * t / 30) for t in range(9)], hops=0.5))
    assert len(found) == 1
    np.testing.assert_allclose(found.means[0, :, 0], 0.005, atol=2e-3)
    apart = found.disagreements[0, :, 0, 0]
    np.testing.assert_allclose(apart, 0.25e-4, rtol=0.1)
    assert (found.marginal_covariances[0, :, 0, 0] > apart).all()


def test_motions_have_the_weight_of_all_their_paths(modes, walk, chained, monkeypatch):
    """Each of several distant paths is a motion; with fewer motions weights still sum to one."""
    monkeypatch.setattr(motion_smoother, 'MIN_WEIGHT', 0.0)
    images = chained(modes(3.0, times=3), hops=0.2)
    found = MotionSmoother(walk, max_motions=27).smooth(images)
    assert len(found) > 8
    oldest = backward_weights([image.link for image in images])[0]
    first = np.abs(found.means[:, 0, None] - images[0].mixture.means).sum(2).argmin(1)
    # The states of a path start near its first mode.
    np.testing.assert_allclose(np.bincount(first, found.weights), oldest, atol=0.02)
    few = MotionSmoother(walk, max_motions=2).smooth(images)
    assert len(few) == 2
    assert few.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert (np.diff(found.weights) <= 0).all()


def test_limits_hold_for_means_and_samples(modes, walk, chained):
    low, high = np.array([-0.5, -1.0]), np.array([0.7, 1.0])
    found = MotionSmoother(walk, low, high).smooth(chained(modes(2.0), hops=0.1))
    samples = found.sample(200, np.random.default_rng(0))
    for poses in (found.means, samples):
        assert ((poses >= low) & (poses <= high)).all()
    assert (found.means == high).any()


@pytest.mark.parametrize('factor', [1.0, 4.0])
def test_a_motion_that_is_livelier_is_followed(chained, factor):
    """A motion is faster than the prior; images measure it to 0.1 m."""
    dynamics = LinearGaussianDynamics.constant_velocity([0.5], 0.5)
    times = np.arange(45) / 30
    place = 0.3 * np.sin(np.pi * factor * times)
    mixtures = [GaussianMixture([1.0], [[x]], [[[0.1**2]]]) for x in place]
    images = chained(mixtures, [round(1e9 * t) for t in times])
    found = MotionSmoother(dynamics, points=as_points).smooth(images)
    assert np.abs(found.means[0, :, 0] - place).mean() < 0.05
    stiff = MotionSmoother(dynamics).smooth(images)
    assert (np.abs(stiff.means[0, :, 0] - place).mean() > 0.1) == (factor > 1.0)


def test_a_wrong_image_is_passed_over_and_does_not_come_back(chained):
    """One image shows another place: neither its window nor later ones follow it."""
    dynamics = LinearGaussianDynamics.constant_velocity([0.5], 0.5)
    places = np.where(np.arange(40) == 12, 0.9, 0.0)
    images = chained(
        [GaussianMixture([1.0], [[x]], [[[1e-4]]]) for x in places],
        [round(1e9 * t / 30) for t in range(40)],
    )
    window = SlidingWindow(MotionSmoother(dynamics, points=as_points), 0.4)
    final = [pose for image in images for pose in window.step(image).final]
    final += window.finish()
    assert len(final) == 40
    assert max(abs(float(pose.mixture.means[0, 0])) for pose in final) < 0.02


@pytest.mark.parametrize('known', [True, False])
def test_joint_densities_are_those_of_prior_and_images(modes, chained, known):
    """log p(X) + sum log N(x_t; z_t, R_t) at the states; a free first state has density 1."""
    mixtures = modes(0.4, times=4)
    stamps, intervals = [0, 10**8, 2 * 10**8, 4 * 10**8], np.array([0.1, 0.1, 0.2])
    smoother = MotionSmoother(FAST)
    images = chained(mixtures, stamps)
    window = [
        smoother.image(one, None if t == 0 else stamps[t - 1]) for t, one in enumerate(images)
    ]
    past = None
    if known:
        rng = np.random.default_rng(1)
        first = FirstStates(rng.normal(size=(3, 4)), np.array([np.eye(4)] * 3), np.ones(3))
        past = Past(np.eye(3), first, np.zeros((3, 2, 1)))
    found = smoother.smoothed(window, past)
    differ = []
    for m in range(len(found.trajectories)):
        x = found.trajectories.states[m]
        log = 0.0
        for t, dt in enumerate(intervals):
            a, q = FAST.transition(float(dt))
            away = x[t + 1] - a @ x[t]
            log -= 0.5 * away @ np.linalg.solve(q, away) + 0.5 * np.linalg.slogdet(q)[1]
        for t in range(4):
            spread = found.evidence.covariances[m, t]
            away = x[t, :2] - found.evidence.means[m, t]
            log -= 0.5 * away @ np.linalg.solve(spread, away) + 0.5 * np.linalg.slogdet(spread)[1]
        if known:
            away = x[0] - found.first.means[m]
            log -= 0.5 * away @ np.linalg.solve(found.first.covariances[m], away)
        else:
            log -= 0.5 * x[0, 2:] @ FAST.initial_precision[2:, 2:] @ x[0, 2:]
        differ.append(found.trajectories.log_joint[m] - log)
    assert len(differ) == 3
    np.testing.assert_allclose(differ, differ[0], atol=1e-8)
    assert np.isfinite(logsumexp(found.trajectories.log_joint))


def test_one_image(modes, walk, chained):
    """Every mode of one image is a motion; nothing is merged."""
    (image,) = chained(modes(2.0, times=1))
    found = MotionSmoother(walk).smooth([image])
    order = np.argsort(-image.link.weights, kind='stable')
    np.testing.assert_allclose(found.weights, image.link.weights[order], atol=1e-12)
    np.testing.assert_allclose(found.means[:, 0], image.mixture.means[order], atol=1e-9)
    np.testing.assert_allclose(
        found.marginal_covariances[:, 0], image.mixture.covariances[order], atol=1e-9
    )


def test_two_thousand_images_of_two_modes(chained, rng):
    """A minute of 37 variables in one window takes seconds and far less than a gigabyte."""
    d, count = 37, 2000
    dynamics = LinearGaussianDynamics.constant_velocity(np.full(d, 0.5), 0.5)
    covariances = np.tile(1e-3 * np.eye(d), (2, 1, 1))
    drift = np.cumsum(0.003 * rng.normal(size=(count, d)), axis=0)
    side = np.zeros((2, d))
    side[1, :5] = 0.5
    mixtures = [GaussianMixture([0.6, 0.4], drift[t] + side, covariances) for t in range(count)]
    images = chained(
        mixtures,
        [round(1e9 * t / 30) for t in range(count)],
    )
    points = lambda poses: poses[:, :36].reshape(-1, 12, 3)  # noqa: E731
    smoother = MotionSmoother(dynamics, points=points)
    tracemalloc.start()
    begin = time.process_time()
    found = smoother.smooth(images)
    seconds, (_, peak) = time.process_time() - begin, tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert seconds < 30.0
    assert peak < 1e9
    assert len(found) == 2
    for m, away in ((0, side[0]), (1, side[1])):
        assert np.abs(found.means[m] - drift - away).mean() < 0.05


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'max_motions': 0}, 'max_motions must be at least 1, saw 0'),
        ({'lower': [0.0, 1.0, 2.0]}, r'wanted \(2,\)'),
        ({'lower': [0.0, 1.0], 'upper': [1.0, 0.0]}, 'variable 1: lower 1.0 is above upper 0.0'),
    ],
)
def test_bad_settings_are_refused(walk, settings, message):
    with pytest.raises(ValueError, match=message):
        MotionSmoother(walk, **settings)


def test_no_images_are_refused(walk):
    with pytest.raises(ValueError, match='no images to smooth'):
        MotionSmoother(walk).smooth([])


def test_stamps_that_do_not_increase_are_refused(modes, walk, chained):
    for stamps in ([0, 5, 5], [0, 5, 4]):
        with pytest.raises(ValueError, match='stamps must increase'):
            MotionSmoother(walk).smooth(chained(modes(1.0, times=3), stamps))


def as_limbs(poses: np.ndarray) -> np.ndarray:
    """One point per pose, at its first variable, m."""
    return np.stack([poses[:, 0], 0.0 * poses[:, 0], 0.0 * poses[:, 0]], axis=1)[:, None]


def jumping(chained, places, **kwargs):
    """Images of one mode at positions (T,) along one variable, 30 per second."""
    mixtures = [GaussianMixture([1.0], [[x]], [[[4e-4]]]) for x in places]
    stamps = [round(1e9 * t / 30) for t in range(len(places))]
    walk = LinearGaussianDynamics.random_walk([3e-3])
    return MotionSmoother(walk, points=as_limbs, **kwargs).smooth(chained(mixtures, stamps))


def test_states_follow_where_the_chain_goes_over_to_another_pose(chained):
    """Before and after the change they are near the modes; a single image is ignored."""
    found = jumping(chained, [0.0] * 8 + [0.8] * 8)
    # From a tenth of a second before and after the change.
    np.testing.assert_allclose(found.means[0, :5, 0], 0.0, atol=0.02)
    np.testing.assert_allclose(found.means[0, 11:, 0], 0.8, atol=0.02)
    alone = jumping(chained, [0.0] * 8 + [0.8] + [0.0] * 7)
    assert np.abs(alone.means[0, :, 0]).max() < 0.1


def test_modes_that_are_opposite_are_no_one_gaussian(chained):
    """A motion keeps its pose in an image in which a third of its paths have a distant one."""
    mixtures, stamps = [], [round(1e9 * t / 30) for t in range(16)]
    for t in range(16):
        both = [[0.0], [0.8]] if t == 8 else [[0.0], [0.0]]
        mixtures.append(GaussianMixture([0.7, 0.3], both, [[[1e-4]]] * 2))
    walk = LinearGaussianDynamics.random_walk([0.3])
    smoother = MotionSmoother(walk, points=as_limbs)
    found = smoother.smooth(chained(mixtures, stamps, hops=0.5))
    assert len(found) == 1
    assert np.abs(found.means[0, :, 0]).max() < 0.05
    assert found.disagreements[0, 8, 0, 0] < 1e-3
    # The density of that image includes the other pose, and the motion stays heaviest.
    marginal = found.marginal(8)
    assert marginal.means[1:, 0].tolist() == [0.8]
    stray = backward_weights([x.link for x in chained(mixtures, stamps, hops=0.5)])[8][1]
    assert marginal.weights[1] == pytest.approx(stray, abs=1e-12)
    assert len(found.marginal(4)) == 1


def test_motions_weigh_what_the_modes_near_them_do(chained):
    """At every time, for any number of drawn paths."""
    mixtures = [GaussianMixture([0.55, 0.45], [[0.0], [0.4]], [[[1e-4]]] * 2)] * 16
    stamps = [round(1e9 * t / 30) for t in range(16)]
    images = chained(mixtures, stamps, hops=0.03)
    walk = LinearGaussianDynamics.random_walk([0.3])
    found = MotionSmoother(walk, points=as_limbs).smooth(images)
    for t, wanted in enumerate(backward_weights([image.link for image in images])):
        near = np.abs(found.means[:, t, 0, None] - [0.0, 0.4]).argmin(1)
        weights = np.bincount(near, found.weights_in_time[t], minlength=2)
        np.testing.assert_allclose(weights, wanted, atol=1e-12)


@pytest.mark.parametrize(
    ('weights', 'wanted'),
    [
        ([0.5, 0.3, 0.2], [0.5, 0.3, 0.2]),
        ([0.2, 0.6, 0.2], [0.4, 0.4, 0.2]),
        ([0.1, 0.5, 0.4], [1 / 3, 1 / 3, 1 / 3]),
        ([0.0, 1.0], [0.5, 0.5]),
        ([1.0], [1.0]),
    ],
)
def test_the_first_component_leads(weights, wanted):
    np.testing.assert_allclose(weights_capped_by_first(np.array(weights)), wanted, atol=1e-12)
