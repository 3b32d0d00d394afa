"""The smoother, compared with exact posteriors; refused input; the returned mixture."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics, MixtureSmoother, TrajectoryMixture
from hmt_ros.smoothing.likelihood import counted
from hmt_ros.smoothing.mixture_smoother import LONG_WINDOW
from hmt_ros.smoothing.mode_sequence import ModeSequence
from hmt_ros.smoothing.trajectory_refinement import refine
from msg_tools import RosbagsMessages
from msg_tools.messages import trajectory_mixtures

FAST = LinearGaussianDynamics.constant_velocity([4.0, 4.0], 1.0)


def divergence(exact: GaussianMixture, found: GaussianMixture) -> float:
    x = exact.sample(1500, np.random.default_rng(0))
    return float((exact.log_density(x) - found.log_density(x)).mean())


@pytest.mark.parametrize(('radius', 'limit'), [(4.0, 0.02), (1.0, 0.1)])
@pytest.mark.parametrize('rate', [1.0, 9.0])
def test_marginals_are_close_to_those_of_the_exact_posterior(modes, exact, radius, limit, rate):
    mixtures = modes(radius, seed=3)
    dynamics = LinearGaussianDynamics.random_walk([rate, rate])
    found = MixtureSmoother(dynamics).smooth(mixtures)
    evidence, marginals = exact(mixtures, dynamics, np.ones(4))
    each = [divergence(p, found.marginal(t)) for t, p in enumerate(marginals)]
    assert np.mean(each) < limit
    assert found.free_energy_fresh[0] > -evidence - 4 * found.free_energy_fresh[1]


def test_uneven_intervals_are_bridged_by_the_dynamics(modes, walk, exact):
    mixtures = modes(1.0)
    stamps = np.array([0, 100, 150, 1150, 1200]) * 10**6
    found = MixtureSmoother(walk).smooth(mixtures, stamps_ns=stamps)
    _, marginals = exact(mixtures, walk, np.diff(stamps) * 1e-9)
    assert np.mean([divergence(p, found.marginal(t)) for t, p in enumerate(marginals)]) < 0.1
    assert found.stamps_ns == tuple(stamps)


@pytest.fixture
def found(modes, walk) -> TrajectoryMixture:
    return MixtureSmoother(walk, max_trajectories=5).smooth(
        modes(1.5, times=4), stamps_ns=np.arange(4) * 10**9
    )


@pytest.fixture
def moving(modes) -> TrajectoryMixture:
    return MixtureSmoother(FAST, max_trajectories=3).smooth(modes(1.5, times=4))


def dense_components(mixture: TrajectoryMixture):
    """Means (M, T d) and covariances (M, T d, T d) of the poses, by dense inverses."""
    times, d, n = mixture.times, mixture.dimension, mixture.states.shape[2]
    for i in range(len(mixture)):
        lower = np.zeros((times, n, times, n))
        own, below = mixture.factors[i].blocks
        for t in range(times):
            lower[t, :, t] = own[t]
        for t, block in enumerate(below):
            lower[t + 1, :, t] = block
        lower = lower.reshape(times * n, -1)
        covariance = np.linalg.inv(lower @ lower.T).reshape(times, n, times, n)
        covariance = mixture.inflation[i] ** 2 * covariance[:, :d, :, :d]
        yield mixture.means[i].reshape(-1), covariance.reshape(times * d, -1)


@pytest.mark.parametrize('kind', ['found', 'moving'])
def test_density_marginals_and_samples_agree_with_dense_algebra(kind, request):
    mixture = request.getfixturevalue(kind)
    x = mixture.sample(20_000, np.random.default_rng(0))
    assert x.shape == (20_000, 4, 2)
    flat = x.reshape(len(x), -1)
    density, mean, second = 0.0, 0.0, 0.0
    for i, (centre, covariance) in enumerate(dense_components(mixture)):
        weight = mixture.weights[i]
        density = density + weight * multivariate_normal(centre, covariance).pdf(flat[:50])
        mean = mean + weight * centre
        second = second + weight * (covariance + np.outer(centre, centre))
        blocks = covariance.reshape(4, 2, 4, 2)
        for t in range(4):
            np.testing.assert_allclose(mixture.marginal_covariances[i, t], blocks[t, :, t])
    np.testing.assert_allclose(mixture.log_density(x[:50]), np.log(density), rtol=1e-8)
    np.testing.assert_allclose(mixture.mean().reshape(-1), mean)
    covariance = second - np.outer(mean, mean)
    np.testing.assert_allclose(np.cov(flat.T), covariance, atol=0.05 * covariance.max())
    with pytest.raises(ValueError, match=r'wanted \(n, 4, 2\)'):
        mixture.log_density(x[:, :3])


def test_heaviest_first_and_joint_densities(found, modes, walk):
    assert (np.diff(found.weights) <= 0).all()
    assert found.weights.sum() == pytest.approx(1.0)
    mixtures = modes(1.5, times=4)
    seen = sum(m.log_density(found.means[:, t]) for t, m in enumerate(mixtures))
    prior = walk.prior(np.ones(3)).energy(found.states)[0]
    np.testing.assert_allclose(found.log_joint, seen - prior)


def test_to_a_message_and_back(found):
    content = trajectory_mixtures.TrajectoryMixture(
        **found.message_content(), body_model='two', dof_names=('a', 'b'), frame_id='camera'
    )
    messages = RosbagsMessages()
    message = trajectory_mixtures.trajectory_mixture_message(messages, content)
    back = trajectory_mixtures.trajectory_mixture_of(message, ('a', 'b'))
    np.testing.assert_allclose(back.means, found.means)
    np.testing.assert_allclose(back.weights, found.weights)
    np.testing.assert_allclose(back.marginal_covariances, found.marginal_covariances, rtol=1e-9)
    np.testing.assert_allclose(back.inflation, found.inflation)
    np.testing.assert_allclose(back.free_energy, found.free_energy)
    assert back.stamps_ns == found.stamps_ns
    assert back.final_until_ns == found.stamps_ns[0] - 1


def test_what_can_not_become_a_message(modes, walk):
    with pytest.raises(ValueError, match='without stamps'):
        MixtureSmoother(walk, max_trajectories=2).smooth(modes(2.0)).message_content()


def test_limits_hold_for_means_and_samples(modes, walk):
    low, high = np.array([-0.5, -1.0]), np.array([0.7, 1.0])
    found = MixtureSmoother(walk, low, high, max_trajectories=8).smooth(modes(2.0))
    samples = found.sample(200, np.random.default_rng(0))
    for poses in (found.means, samples):
        assert ((poses >= low) & (poses <= high)).all()
    assert (found.means == high).any()


def test_the_same_seed_gives_the_same_numbers(modes, walk):
    one, same = (MixtureSmoother(walk).smooth(modes(1.0), seed=4) for _ in range(2))
    for name in ('weights', 'states', 'inflation', 'log_joint', 'free_energy'):
        np.testing.assert_array_equal(getattr(one, name), getattr(same, name))


def test_adapting_nothing(modes, walk):
    plain = MixtureSmoother(walk, adapt=(), max_trajectories=4).smooth(modes(4.0))
    np.testing.assert_array_equal(plain.inflation, 1.0)
    assert len(plain.free_energy) == 1


def test_one_time_one_mode_and_modes_without_weight(walk):
    one = GaussianMixture([2.0], [[0.3, 0.1]], [np.eye(2)])
    found = MixtureSmoother(walk).smooth([one])
    np.testing.assert_allclose(found.means[0, 0], [0.3, 0.1], atol=1e-6)
    np.testing.assert_allclose(found.marginal(0).covariances[0], np.eye(2), atol=1e-3)
    empty = GaussianMixture([2.0, 0.0], [[0.3, 0.1], [9.0, 9.0]], [np.eye(2)] * 2)
    same = MixtureSmoother(walk).smooth([empty, one])
    np.testing.assert_allclose(same.means, MixtureSmoother(walk).smooth([one, one]).means)


EMPTY = GaussianMixture(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2, 2)))
FLAT = GaussianMixture([1.0], [[0.0, 0.0]], [np.diag([1.0, -0.1])])
WIDE = GaussianMixture([1.0], [[0.0, 0.0, 0.0]], [np.eye(3)])


@pytest.mark.parametrize(
    ('given', 'stamps', 'message'),
    [
        ([], None, 'no mixtures'),
        ([0, EMPTY], None, r'mixture 1 of 2 has no modes'),
        ([0, FLAT], None, r'mixture 1 of 2: covariance of component 0 is not positive definite'),
        ([0, WIDE], None, r'mixture 1 has 3 variables'),
        ([WIDE, WIDE], None, 'the dynamics 2'),
        ([0, 0, 0], [0, 5, 5], 'stamps must increase, saw 5 ns after 5 ns'),
        ([0, 0, 0], [0, 5], '2 stamps for 3 mixtures'),
    ],
)
def test_bad_input_is_refused_in_one_line(modes, walk, given, stamps, message):
    good = modes(1.0)[0]
    mixtures = [good if m == 0 else m for m in given]
    with pytest.raises(ValueError, match=message) as error:
        MixtureSmoother(walk).smooth(mixtures, stamps_ns=stamps)
    assert '\n' not in str(error.value)


@pytest.mark.parametrize(
    ('settings', 'message'),
    [
        ({'max_trajectories': 0}, 'max_trajectories'),
        ({'adapt': ('mean',)}, "no 'mean'"),
        ({'lower': [0.0, 1.0, 2.0]}, r'wanted \(2,\)'),
        ({'lower': [0.0, 1.0], 'upper': [1.0, 0.0]}, 'variable 1: lower 1.0 is above upper 0.0'),
    ],
)
def test_bad_settings_are_refused(walk, settings, message):
    with pytest.raises(ValueError, match=message):
        MixtureSmoother(walk, **settings)


def test_not_a_number_is_refused_where_it_comes_in():
    with pytest.raises(ValueError, match='not finite'):
        GaussianMixture([1.0], [[np.nan]], [[[1.0]]])


def test_what_counts_of_an_observation_is_a_power_of_it():
    """For distant modes, log q = a log p up to a constant, near each of them."""
    spread = np.array([[0.5, 0.2], [0.2, 0.3]])
    means = np.array([[-9.0, 0.0], [9.0, 4.0]])
    mixture = GaussianMixture([0.9, 0.1], means, [spread, 0.2 * spread])
    rng = np.random.default_rng(0)
    points = means[[0, 1] * 5] + rng.normal(size=(10, 2))
    for share in (1.0, 0.3):
        found = counted(mixture, share)
        assert found.weights.sum() == pytest.approx(1.0)
        offset = found.log_density(points) - share * mixture.log_density(points)
        np.testing.assert_allclose(offset, offset[0], atol=1e-6)
    # A mode without weight gets none; one with little weight gets more.
    light = counted(GaussianMixture([1.0, 1e-300, 0.0], [[0.0], [1.0], [2.0]], [[[1.0]]] * 3), 0.1)
    np.testing.assert_allclose(light.weights, [1.0, 1e-30], rtol=1e-9)
    for share in (0.0, -0.5, 1.5):
        with pytest.raises(ValueError, match='share of the evidence'):
            counted(mixture, share)


def test_parts_of_a_long_sequence_lead_to_the_same_optima(modes):
    """Refined first in parts that differ from the best path, or as a whole."""
    mixtures = tuple(modes(2.0, times=LONG_WINDOW + 20))
    dynamics = LinearGaussianDynamics.random_walk([0.5, 0.5])
    sequence = ModeSequence(mixtures, dynamics, np.ones(len(mixtures) - 1))
    found = MixtureSmoother(dynamics, -9.0, 9.0, max_trajectories=9).optima(
        sequence, sequence.likelihood
    )
    starts = sequence.states(sequence.paths(9))
    best = refine(starts[:1], sequence.prior, sequence.likelihood, -9.0, 9.0)
    shared = sequence.paths(9).nodes == sequence.paths(9).nodes[0]
    starts = np.where(shared[:, :, None], best.states, starts)
    whole = refine(starts, sequence.prior, sequence.likelihood, -9.0, 9.0).without_duplicates()
    # A minimum is found to 1e-6 nats, which corresponds to this share of a deviation.
    np.testing.assert_allclose(found.states[: len(whole)], whole.states, atol=5e-3)


def test_a_part_has_the_slope_of_the_whole(modes):
    dynamics = LinearGaussianDynamics.constant_velocity([1.0, 2.0], 1.5)
    prior = dynamics.prior(np.array([0.5, 1.0, 0.7, 1.0, 1.0]))
    x = np.random.default_rng(0).normal(size=(6, 4))
    slope = prior.energy(x[None])[1][0]
    for first, last in ((0, 3), (2, 5), (3, 6)):
        part = prior.between(first, last, x).energy(x[None, first:last])[1][0]
        np.testing.assert_allclose(part, slope[first:last], atol=1e-10)
