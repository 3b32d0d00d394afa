"""The sliding window: exact filtering, marginals, identities, cost and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics, MixtureSmoother, SlidingWindow
from hmt_ros.smoothing.mixture_smoother import PathSmoother

FAST = LinearGaussianDynamics.constant_velocity([2.0, 2.0], 1.0)


def divergence(exact: GaussianMixture, found: GaussianMixture) -> float:
    x = exact.sample(1500, np.random.default_rng(0))
    return float((exact.log_density(x) - found.log_density(x)).mean())


def run(window: SlidingWindow, mixtures, step=10**9):
    updates = [window.step(t * step, mixture) for t, mixture in enumerate(mixtures)]
    final = [pose for update in updates for pose in update.final]
    return updates, [*final, *window.finish()]


def test_final_marginals_are_those_given_what_the_lag_saw(modes, walk, exact):
    mixtures = modes(1.2, times=6)
    _, final = run(SlidingWindow(MixtureSmoother(walk), fixed_lag=2), mixtures)
    assert [pose.stamp_ns for pose in final] == [t * 10**9 for t in range(6)]
    for t, pose in enumerate(final):
        seen = mixtures[: t + 3]
        _, marginals = exact(seen, walk, np.ones(len(seen) - 1))
        assert divergence(marginals[t], pose.mixture) < 0.1


@pytest.mark.parametrize('moving', [True, False])
def test_velocities_of_final_poses(walk, moving):
    """A point moves by (2, -1) a second; a state with a velocity takes it to rest at first."""
    chosen = FAST if moving else walk
    places = np.array([2.0, -1.0]) * np.arange(8)[:, None]
    mixtures = [GaussianMixture([1.0], [place], [1e-4 * np.eye(2)]) for place in places]
    _, final = run(SlidingWindow(MixtureSmoother(chosen), fixed_lag=3), mixtures)
    for t, pose in enumerate(final):
        tolerance = 0.8 * 0.4**t if moving else 0.0
        np.testing.assert_allclose(pose.velocities, [[2.0, -1.0]], atol=0.02 + tolerance)
        assert pose.identities == (1,)
    # Of one pose alone nothing is known.
    _, (alone,) = run(SlidingWindow(MixtureSmoother(walk), fixed_lag=3), mixtures[:1])
    assert alone.velocities is None


def test_a_window_that_is_not_full_is_the_whole_sequence(modes, walk):
    mixtures = modes(3.0, times=4)
    window = SlidingWindow(PathSmoother(walk, max_trajectories=12), fixed_lag=10)
    updates, final = run(window, mixtures)
    assert all(update.final == () for update in updates)
    whole = PathSmoother(walk, max_trajectories=12).smooth(mixtures)
    np.testing.assert_allclose(updates[-1].trajectories.means, whole.means, atol=1e-5)
    assert len(final) == 4
    assert window.stamps_ns == ()
    assert window.finish() == ()


def test_what_is_final_is_not_revised_and_the_window_does_not_grow(modes):
    mixtures = modes(2.0, times=9)
    window = SlidingWindow(MixtureSmoother(FAST, max_trajectories=8), fixed_lag=0.3)
    until = -1
    for t, mixture in enumerate(mixtures):
        update = window.step(t * 10**8, mixture)
        found = update.trajectories
        assert found.times == min(t + 1, 4)
        assert found.stamps_ns == window.stamps_ns
        for pose in update.final:
            assert pose.stamp_ns > until
            until = pose.stamp_ns
        assert found.final_until_ns == (until if until >= 0 else None)
        assert found.stamps_ns[0] >= until
        assert len(found) <= 16


def test_hypotheses_keep_their_identity(modes, walk):
    """Two modes far apart: two trajectories, that are followed over many windows."""
    rng = np.random.default_rng(0)
    window = SlidingWindow(MixtureSmoother(walk, max_trajectories=2), fixed_lag=3)
    seen = []
    for t in range(10):
        means = [[-30.0, 0.0], [30.0, 0.1 * t]]
        order = rng.permutation(2)
        mixture = GaussianMixture([0.5, 0.5], np.array(means)[order], [np.eye(2)] * 2)
        found = window.step(t * 10**9, mixture).trajectories
        left = int(np.argmin(found.means[:, -1, 0]))
        seen.append((found.identities[left], len(found)))
    assert len(set(seen[2:])) == 1


def test_a_motion_that_splits_goes_on_as_the_heavier_part(walk):
    window = SlidingWindow(MixtureSmoother(walk, max_trajectories=2), fixed_lag=3)
    sharp = [1e-4 * np.eye(2)]
    place, left, right = [0.0, 0.0], [-1.0, 0.0], [1.0, 0.0]
    found = window.step(0, GaussianMixture([1.0], [place], sharp)).trajectories
    assert found.identities == (1,)
    mixture = GaussianMixture([0.3, 0.7], [left, right], 2 * sharp)
    found = window.step(10**9, mixture).trajectories
    assert found.identities == (1, 2)
    assert found.means[0, -1, 0] > 0.9
    # Later the other one is the heavier, and both keep their numbers.
    mixture = GaussianMixture([0.9, 0.1], [left, right], 2 * sharp)
    found = window.step(2 * 10**9, mixture).trajectories
    assert found.means[0, -1, 0] < -0.9
    assert found.identities == (2, 1)
    assert window.next_identity == 3


def test_a_motion_that_is_revised_by_more_than_the_bound_is_another_one():
    """The points that a motion is seen by decide, not its variables."""
    dynamics = LinearGaussianDynamics.random_walk([1.0])
    for scale, wanted in ((1.0, (2,)), (0.1, (1,))):
        window = SlidingWindow(
            MixtureSmoother(dynamics, points=lambda poses, s=scale: s * poses[..., None]), 3.0
        )
        window.step(0, GaussianMixture([1.0], [[0.0]], [[[1.0]]]))
        # The pose before moves by half a metre.
        found = window.step(10**9, GaussianMixture([1.0], [[1.0]], [[[0.1]]])).trajectories
        assert found.means[0, 0, 0] == pytest.approx(1.0 / 2.1, abs=0.02)
        assert found.identities == wanted


def test_gaps_are_bridged_by_the_dynamics(modes, walk, exact):
    mixtures = modes(1.2, times=4)
    stamps = np.array([0, 1, 9, 10]) * 10**9
    window = SlidingWindow(MixtureSmoother(walk), fixed_lag=20)
    for stamp, mixture in zip(stamps, mixtures):
        update = window.step(int(stamp), mixture)
    _, marginals = exact(mixtures, walk, np.diff(stamps) * 1e-9)
    for t, marginal in enumerate(marginals):
        assert divergence(marginal, update.trajectories.marginal(t)) < 0.1


def test_the_same_observations_give_the_same_numbers(modes, walk):
    window = SlidingWindow(MixtureSmoother(walk, max_trajectories=8), fixed_lag=2, seed=3)
    one, _ = run(window, modes(1.0))
    again, _ = run(window, modes(1.0))
    for a, b in zip(one, again):
        np.testing.assert_array_equal(a.trajectories.states, b.trajectories.states)
        np.testing.assert_array_equal(a.trajectories.weights, b.trajectories.weights)
        assert a.trajectories.identities == b.trajectories.identities


def test_lag_zero_is_a_filter(modes, walk, exact):
    mixtures = modes(3.0, times=4)
    updates, final = run(SlidingWindow(MixtureSmoother(walk), fixed_lag=0), mixtures)
    assert all(len(update.final) == 1 for update in updates)
    _, marginals = exact(mixtures, walk, np.ones(3))
    assert divergence(marginals[-1], final[-1].mixture) < 0.02


def test_bad_input_leaves_the_window_as_it_was(modes, walk):
    mixtures = modes(2.0)
    window = SlidingWindow(MixtureSmoother(walk, max_trajectories=4), fixed_lag=2)
    window.step(5, mixtures[0])
    empty = GaussianMixture(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2)))
    wide = GaussianMixture([1.0], [[0.0] * 3], [np.eye(3)])
    for stamp, mixture, message in (
        (5, mixtures[1], 'stamps must increase, saw 5 ns after 5 ns'),
        (4, mixtures[1], 'stamps must increase'),
        (6, empty, 'no modes'),
        (6, wide, 'the dynamics 2'),
    ):
        with pytest.raises(ValueError, match=message):
            window.step(stamp, mixture)
    assert window.stamps_ns == (5,)
    assert window.step(6, mixtures[1]).trajectories.times == 2
    with pytest.raises(ValueError, match='fixed_lag'):
        SlidingWindow(MixtureSmoother(walk), fixed_lag=-1)


@pytest.mark.parametrize(
    ('interval', 'age'), [(0.1, 0.7), (0.2, 0.6), (0.25, 0.5), (0.5, 0.5), (0.9, 0.9)]
)
def test_poses_are_final_before_they_are_older_than_the_lag(modes, interval, age):
    window = SlidingWindow(MixtureSmoother(FAST, max_trajectories=4), fixed_lag=0.7)
    step = round(interval * 1e9)
    found = set()
    final = []
    for t, mixture in enumerate(modes(2.0, times=12)):
        update = window.step(t * step, mixture)
        assert len(window.stamps_ns) <= 8
        final += update.final
        if t > 7:
            found |= {round((t * step - pose.stamp_ns) * 1e-9, 3) for pose in update.final}
    # At 0.9 s the one before is already too old when the next comes, and is told at once then.
    assert found == {age}
    final += window.finish()
    assert [pose.stamp_ns for pose in final] == [t * step for t in range(12)]


def test_stamps_that_tremble_do_not_change_the_lag(modes):
    window = SlidingWindow(MixtureSmoother(FAST, max_trajectories=4), fixed_lag=0.3)
    rng = np.random.default_rng(0)
    for t, mixture in enumerate(modes(2.0, times=12)):
        update = window.step(t * 10**8 + int(rng.integers(-3 * 10**6, 3 * 10**6)), mixture)
        assert len(update.final) == (t >= 3)


def test_after_a_gap_all_old_poses_are_final(modes, walk):
    mixtures = modes(2.0, times=6)
    window = SlidingWindow(MixtureSmoother(walk), fixed_lag=0.7)
    for t in range(4):
        assert window.step(t * 10**8, mixtures[t]).final == ()
    update = window.step(5 * 10**9, mixtures[4])
    assert [pose.stamp_ns for pose in update.final] == [t * 10**8 for t in range(4)]
    assert window.step(5 * 10**9 + 10**8, mixtures[5]).final == ()
    assert window.stamps_ns == (5 * 10**9, 5 * 10**9 + 10**8)
    assert [pose.stamp_ns for pose in window.finish()] == [5 * 10**9, 5 * 10**9 + 10**8]


def test_an_endless_lag_keeps_all_poses_open(modes, walk):
    updates, final = run(
        SlidingWindow(MixtureSmoother(walk), fixed_lag=np.inf), modes(2.0, times=4)
    )
    assert all(update.final == () for update in updates)
    assert len(final) == 4


def test_neighbours_are_smoothed_together(modes):
    mixtures = modes(2.0, times=18)
    stamps = [round(33_333_333.3 * t) for t in range(len(mixtures))]

    def final(every):
        smoother = MixtureSmoother(FAST, max_trajectories=8)
        window = SlidingWindow(smoother, fixed_lag=0.3, every=every)
        updates = [window.step(at, one) for at, one in zip(stamps, mixtures, strict=True)]
        poses = [(t, pose) for t, update in enumerate(updates) for pose in update.final]
        smoothed = sum(update.trajectories is not None for update in updates)
        last = [(len(mixtures) - 1, pose) for pose in window.finish()]
        return smoothed, [*poses, *last]

    count, always = final(0.0)
    fewer, rarely = final(0.1)
    assert (count, fewer) == (18, 6)
    assert [pose.stamp_ns for _, pose in rarely] == stamps
    assert [pose.stamp_ns for _, pose in always] == stamps
    ages = [(stamps[t] - pose.stamp_ns) / 1e9 for t, pose in rarely]
    assert 0.3 < max(ages) <= 0.4 + 1e-6
    # Those that wait know more, and those that do not know the same.
    for (_, one), (_, other) in zip(always, rarely, strict=True):
        near = np.abs(one.mixture.mean() - other.mixture.mean())
        assert near.max() < 3.0 * np.sqrt(np.diag(one.mixture.covariance()).max())
