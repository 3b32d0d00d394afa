"""The sliding window: exact smoothing, identities, lag, and refused input."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics, MotionSmoother, SlidingWindow

FAST = LinearGaussianDynamics.constant_velocity([2.0, 2.0], 1.0)


def run(window, images):
    updates = [window.step(image) for image in images]
    final = [pose for update in updates for pose in update.final]
    return updates, [*final, *window.finish()]


def every(seconds, count):
    return [round(1e9 * seconds * t) for t in range(count)]


@pytest.mark.parametrize('moving', [True, False])
def test_final_marginals_are_those_given_what_the_lag_saw(modes, walk, chained, dense, moving):
    """Three modes that continue independently: three Gaussians, by dense algebra."""
    dynamics, mixtures = FAST if moving else walk, modes(2.0, times=8)
    stamps = np.cumsum([0, 7, 10, 12, 9, 10, 8, 11]) * 10**8
    _, final = run(SlidingWindow(MotionSmoother(dynamics), 2.2), chained(mixtures, stamps))
    assert [pose.stamp_ns for pose in final] == stamps.tolist()
    ends = {pose.t - pose.trajectories.times for pose in final}
    assert len(ends) > 1
    for t, pose in enumerate(final):
        end = t + pose.trajectories.times - pose.t
        seen = mixtures[:end]
        wanted = mixtures[-1 if end == 8 else end - 1].normalised().weights
        order = np.argsort(-wanted, kind='stable')
        np.testing.assert_allclose(pose.mixture.weights, wanted[order], atol=1e-12)
        for i, k in enumerate(order):
            mean, covariance = dense(seen, [k] * end, dynamics, np.diff(stamps[:end]) / 1e9)
            np.testing.assert_allclose(pose.mixture.means[i], mean[t, :2], atol=1e-8)
            covariance = covariance[t, :2, t, :2]
            np.testing.assert_allclose(pose.mixture.covariances[i], covariance, atol=1e-8)
            if moving:
                np.testing.assert_allclose(pose.velocities[i], mean[t, 2:], atol=1e-8)


@pytest.mark.parametrize('moving', [True, False])
def test_velocities_of_final_poses(walk, chained, moving):
    """A point moves by (2, -1) per second; a state with velocity assumes rest at first."""
    chosen = FAST if moving else walk
    places = np.array([2.0, -1.0]) * np.arange(8)[:, None]
    images = chained([GaussianMixture([1.0], [place], [1e-4 * np.eye(2)]) for place in places])
    _, final = run(SlidingWindow(MotionSmoother(chosen), fixed_lag=3), images)
    for t, pose in enumerate(final):
        tolerance = 0.8 * 0.4**t if moving else 0.0
        np.testing.assert_allclose(pose.velocities, [[2.0, -1.0]], atol=0.02 + tolerance)
        assert pose.identities == (1,)
    # One pose gives no velocity.
    _, (alone,) = run(SlidingWindow(MotionSmoother(walk), fixed_lag=3), images[:1])
    assert alone.velocities is None


def test_a_window_that_is_not_full_is_the_whole_sequence(modes, walk, chained):
    images = chained(modes(3.0, times=4), hops=0.1)
    window = SlidingWindow(MotionSmoother(walk), fixed_lag=10)
    updates, final = run(window, images)
    assert all(update.final == () for update in updates)
    whole = MotionSmoother(walk).smooth(images)
    np.testing.assert_array_equal(updates[-1].trajectories.states, whole.states)
    np.testing.assert_array_equal(updates[-1].trajectories.weights, whole.weights)
    assert len(final) == 4
    assert window.stamps_ns == ()
    assert window.finish() == ()


def test_what_is_final_is_not_revised_and_the_window_does_not_grow(modes, chained):
    window = SlidingWindow(MotionSmoother(FAST, max_motions=4), fixed_lag=0.3)
    until = -1
    for t, image in enumerate(chained(modes(2.0, times=9), every(0.1, 9), hops=0.2)):
        update = window.step(image)
        found = update.trajectories
        assert found.times == min(t + 1, 4)
        assert found.stamps_ns == window.stamps_ns
        for pose in update.final:
            assert pose.stamp_ns > until
            until = pose.stamp_ns
        assert found.final_until_ns == (until if until >= 0 else None)
        assert found.stamps_ns[0] >= until
        assert len(found) <= 4


def test_motions_keep_their_identity(walk, chained):
    """Two distant modes in changing order give two trajectories over many windows."""
    rng = np.random.default_rng(0)
    window = SlidingWindow(MotionSmoother(walk), fixed_lag=3)
    orders = [rng.permutation(2) for _ in range(10)]
    mixtures = [
        GaussianMixture(
            [0.5, 0.5], np.array([[-30.0, 0.0], [30.0, 0.1 * t]])[order], [np.eye(2)] * 2
        )
        for t, order in enumerate(orders)
    ]
    origins = [np.empty((2, 0)), *(1.0 * (b[:, None] == a) for a, b in pairwise(orders))]
    seen = []
    for image in chained(mixtures, origins=origins):
        found = window.step(image).trajectories
        assert len(found) == 2
        seen.append(found.identities[int(np.argmin(found.means[:, -1, 0]))])
    assert len(set(seen)) == 1


def test_a_motion_that_splits_goes_on_as_the_heavier_part(walk, chained):
    window = SlidingWindow(MotionSmoother(walk), fixed_lag=3)
    sharp = [1e-4 * np.eye(2)]
    place, left, right = [0.0, 0.0], [-1.0, 0.0], [1.0, 0.0]
    one, two, three = chained(
        [
            GaussianMixture([1.0], [place], sharp),
            GaussianMixture([0.3, 0.7], [left, right], 2 * sharp),
            # Later the other mode is heavier, and both keep their identities.
            GaussianMixture([0.9, 0.1], [left, right], 2 * sharp),
        ],
        origins=[np.empty((1, 0)), np.ones((2, 1)), np.eye(2)],
    )
    assert window.step(one).trajectories.identities == (1,)
    found = window.step(two).trajectories
    assert found.identities == (1, 2)
    assert found.means[0, -1, 0] > 0.9
    found = window.step(three).trajectories
    assert found.means[0, -1, 0] < -0.9
    assert found.identities == (2, 1)
    assert window.next_identity == 3


def test_a_motion_that_is_revised_by_more_than_the_bound_is_another_one(chained):
    """The bound applies to the points of a motion, not to its variables."""
    dynamics = LinearGaussianDynamics.random_walk([1.0])
    images = chained(
        [GaussianMixture([1.0], [[0.0]], [[[1.0]]]), GaussianMixture([1.0], [[1.0]], [[[0.1]]])]
    )
    for scale, wanted in ((0.1, (2,)), (0.01, (1,))):
        smoother = MotionSmoother(dynamics, points=lambda x, s=scale: s * x[..., None])
        window = SlidingWindow(smoother, 3.0)
        window.step(images[0])
        # The previous pose is revised by half a metre in its variable.
        found = window.step(images[1]).trajectories
        assert found.means[0, 0, 0] == pytest.approx(1.0 / 2.1, abs=0.02)
        assert found.identities == wanted


def test_gaps_are_bridged_by_the_dynamics(modes, chained, dense):
    mixtures = [mixture[:1].normalised() for mixture in modes(1.2, times=4)]
    stamps = np.array([0, 1, 9, 10]) * 10**9
    window = SlidingWindow(MotionSmoother(FAST), fixed_lag=20)
    for image in chained(mixtures, stamps):
        update = window.step(image)
    mean, covariance = dense(mixtures, [0] * 4, FAST, np.diff(stamps) / 1e9)
    np.testing.assert_allclose(update.trajectories.states[0], mean, atol=1e-8)
    np.testing.assert_allclose(
        update.trajectories.marginal(2).covariances[0], covariance[2, :2, 2, :2], atol=1e-8
    )


def test_the_same_observations_give_the_same_numbers(modes, walk, chained):
    window = SlidingWindow(MotionSmoother(walk, seed=3), fixed_lag=2)
    one, _ = run(window, chained(modes(1.0), hops=0.2))
    again, _ = run(window, chained(modes(1.0), hops=0.2))
    for a, b in zip(one, again):
        np.testing.assert_array_equal(a.trajectories.states, b.trajectories.states)
        np.testing.assert_array_equal(a.trajectories.weights, b.trajectories.weights)
        assert a.trajectories.identities == b.trajectories.identities


def test_lag_zero_is_a_filter(modes, walk, chained, dense):
    """Nothing is merged: every mode is a motion with the filter's weight."""
    mixtures = modes(3.0, times=4)
    updates, final = run(SlidingWindow(MotionSmoother(walk), 0.0), chained(mixtures))
    assert all(len(update.final) == 1 for update in updates)
    for t, pose in enumerate(final):
        weights = mixtures[t].normalised().weights
        order = np.argsort(-weights, kind='stable')
        assert pose.mixture.weights == pytest.approx(weights[order], abs=1e-12)
        for i, k in enumerate(order):
            mean, covariance = dense(mixtures[: t + 1], [k] * (t + 1), walk, np.ones(t))
            np.testing.assert_allclose(pose.mixture.means[i], mean[t], atol=1e-8)
            np.testing.assert_allclose(pose.mixture.covariances[i], covariance[t, :, t], atol=1e-8)


def test_bad_input_leaves_the_window_as_it_was(modes, walk, chained):
    window = SlidingWindow(MotionSmoother(walk), fixed_lag=2)
    one, two = chained(modes(2.0, times=2), [5, 6])
    window.step(one)
    empty = GaussianMixture(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    wide = GaussianMixture([1.0] * 3, np.zeros((3, 3)), [np.eye(3)] * 3)
    flat = GaussianMixture([1.0] * 3, np.zeros((3, 2)), [np.diag([1.0, -0.1])] * 3)
    link = two.link
    for bad, message in (
        (two._replace(stamp_ns=5), 'stamps must increase, saw 5 ns after 5 ns'),
        (two._replace(stamp_ns=4), 'stamps must increase'),
        (two._replace(mixture=empty), '0 modes have 3 weights'),
        (two._replace(mixture=wide), 'the dynamics 2'),
        (two._replace(mixture=flat), 'not positive definite'),
        (two._replace(link=link._replace(weights=0.9 * link.weights)), 'weights that sum to 0.9'),
        (two._replace(link=link._replace(weights=link.weights * np.nan)), 'sum to nan'),
        (two._replace(link=link._replace(origins=np.ones((3, 2)))), 'a column for each of 3 modes'),
    ):
        with pytest.raises(ValueError, match=message) as error:
            window.step(bad)
        assert '\n' not in str(error.value)
    assert window.stamps_ns == (5,)
    assert window.step(two).trajectories.times == 2
    with pytest.raises(ValueError, match='fixed_lag'):
        SlidingWindow(MotionSmoother(walk), fixed_lag=-1)


@pytest.mark.parametrize(
    ('interval', 'age'), [(0.1, 0.7), (0.2, 0.6), (0.25, 0.5), (0.5, 0.5), (0.9, 0.9)]
)
def test_poses_are_final_before_they_are_older_than_the_lag(modes, chained, interval, age):
    window = SlidingWindow(MotionSmoother(FAST), fixed_lag=0.7)
    stamps = every(interval, 12)
    found, final = set(), []
    for t, image in enumerate(chained(modes(2.0, times=12), stamps)):
        update = window.step(image)
        assert len(window.stamps_ns) <= 8
        final += update.final
        if t > 7:
            found |= {round((stamps[t] - pose.stamp_ns) * 1e-9, 3) for pose in update.final}
    # At 0.9 s the previous image is already too old when the next one arrives.
    assert found == {age}
    final += window.finish()
    assert [pose.stamp_ns for pose in final] == stamps


def test_stamps_that_tremble_do_not_change_the_lag(modes, chained):
    window = SlidingWindow(MotionSmoother(FAST), fixed_lag=0.3)
    trembling = np.random.default_rng(0).integers(-3 * 10**6, 3 * 10**6, 12)
    for t, image in enumerate(chained(modes(2.0, times=12), every(0.1, 12) + trembling)):
        assert len(window.step(image).final) == (t >= 3)


def test_after_a_gap_all_old_poses_are_final(modes, walk, chained):
    stamps = [0, 10**8, 2 * 10**8, 3 * 10**8, 5 * 10**9, 5 * 10**9 + 10**8]
    images = chained(modes(2.0, times=6), stamps)
    window = SlidingWindow(MotionSmoother(walk), fixed_lag=0.7)
    for image in images[:4]:
        assert window.step(image).final == ()
    assert [pose.stamp_ns for pose in window.step(images[4]).final] == stamps[:4]
    assert window.step(images[5]).final == ()
    assert window.stamps_ns == tuple(stamps[4:])
    assert [pose.stamp_ns for pose in window.finish()] == stamps[4:]


def test_an_endless_lag_keeps_all_poses_open(modes, walk, chained):
    window = SlidingWindow(MotionSmoother(walk), fixed_lag=np.inf)
    updates, final = run(window, chained(modes(2.0, times=4)))
    assert all(update.final == () for update in updates)
    assert len(final) == 4


def test_neighbours_are_smoothed_together(modes, chained):
    stamps = every(1 / 30, 18)
    images = chained(modes(2.0, times=18), stamps)

    def final(rarely):
        window = SlidingWindow(MotionSmoother(FAST), fixed_lag=0.3, every=rarely)
        updates = [window.step(image) for image in images]
        poses = [(t, pose) for t, update in enumerate(updates) for pose in update.final]
        smoothed = sum(update.trajectories is not None for update in updates)
        return smoothed, [*poses, *((17, pose) for pose in window.finish())]

    count, always = final(0.0)
    fewer, rarely = final(0.1)
    assert (count, fewer) == (18, 6)
    assert [pose.stamp_ns for _, pose in rarely] == stamps
    assert [pose.stamp_ns for _, pose in always] == stamps
    ages = [(stamps[t] - pose.stamp_ns) / 1e9 for t, pose in rarely]
    assert 0.3 < max(ages) <= 0.4 + 1e-6
    # Delayed poses use more images; the others are the same.
    for (_, one), (_, other) in zip(always, rarely, strict=True):
        near = np.abs(one.mixture.mean() - other.mixture.mean())
        assert near.max() < 3.0 * np.sqrt(np.diag(one.mixture.covariance()).max())


def test_two_motions_alike_stay_two_over_a_long_run(chained):
    """Equal weights and rare hops: nothing in the smoother decides between them."""
    dynamics = LinearGaussianDynamics.constant_velocity([0.5], 0.5)
    rng = np.random.default_rng(0)
    side = 0.2 + 0.05 * np.sin(np.arange(40) / 6.0)
    mixtures = [
        GaussianMixture([0.5, 0.5], [[x], [-x]], [[[1e-4]], [[4e-4]]])
        for x in side + 0.003 * rng.normal(size=40)
    ]
    images = chained(mixtures, every(1 / 30, 40), hops=0.002)
    window = SlidingWindow(MotionSmoother(dynamics, points=lambda x: x[..., None]), 0.5)
    _, final = run(window, images)
    assert [pose.stamp_ns for pose in final] == every(1 / 30, 40)
    for t, pose in enumerate(final):
        sides = dict(zip(pose.identities, pose.mixture.means[:, 0], strict=True))
        assert sides[1] == pytest.approx(side[t], abs=0.03)
        assert sides[2] == pytest.approx(-side[t], abs=0.03)
        np.testing.assert_allclose(pose.mixture.weights[:2], 0.5, atol=0.05)
