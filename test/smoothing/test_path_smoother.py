"""Smoothing that ends with the paths: exact where all paths are kept."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics, SlidingWindow
from hmt_ros.smoothing.mixture_smoother import PathSmoother
from hmt_ros.smoothing.mode_sequence import ModeSequence, path_gaussians
from hmt_ros.smoothing.path_hypotheses import FilteredPaths, smoothed_paths


def test_it_is_exact_where_all_paths_are_kept(modes, walk, exact):
    mixtures = modes(1.0, times=4)
    found = PathSmoother(walk, max_trajectories=81).smooth(mixtures)
    assert len(found) == 81
    _, marginals = exact(mixtures, walk, np.ones(3))
    x = np.random.default_rng(0).normal(size=(50, 2))
    for t, marginal in enumerate(marginals):
        np.testing.assert_allclose(found.marginal(t).log_density(x), marginal.log_density(x), 1e-6)
    assert (np.diff(found.weights) <= 0).all()
    assert found.free_energy.size == 0


def test_fewer_paths_are_the_heaviest_that_differ(modes, walk):
    mixtures = modes(3.0, times=4)
    whole = PathSmoother(walk, max_trajectories=81).smooth(mixtures)
    few = PathSmoother(walk, max_trajectories=5).smooth(mixtures)
    assert len(few) == 5
    np.testing.assert_allclose(few.means[0], whole.means[0])
    assert few.log_joint[0] == pytest.approx(whole.log_joint[0])


def test_limits(modes, walk):
    mixtures = modes(3.0, times=4)
    free = PathSmoother(walk, max_trajectories=9).smooth(mixtures)
    low = float(free.means.min()) + 0.5
    tight = PathSmoother(walk, [low, low], [9.0, 9.0], max_trajectories=9).smooth(mixtures)
    assert tight.means.min() == low


def test_it_needs_mixtures(modes, walk):
    with pytest.raises(ValueError, match='without an observation'):
        PathSmoother(walk).smooth(modes(3.0, times=2), observation=_Nothing())


class _Nothing:
    times = 2


def test_windows_agree_with_the_filter_where_there_is_one_mode():
    dynamics = LinearGaussianDynamics.random_walk([0.5])
    window = SlidingWindow(PathSmoother(dynamics), fixed_lag=2)
    means, final = [0.0, 1.0, 0.5, 2.0, 1.5], []
    for t, mean in enumerate(means):
        final += window.step(t * 10**9, GaussianMixture([1.0], [[mean]], [[[0.3]]])).final
    final += window.finish()
    assert [pose.stamp_ns for pose in final] == [t * 10**9 for t in range(5)]
    # The last poses are those of the whole sequence, by the dense precision.
    precision = np.diag(np.full(5, 1 / 0.3))
    for t in range(4):
        precision[t : t + 2, t : t + 2] += np.array([[2.0, -2.0], [-2.0, 2.0]])
    covariance = np.linalg.inv(precision)
    wanted = covariance @ (np.array(means) / 0.3)
    for t in (2, 3, 4):
        assert final[t].mixture.mean()[0] == pytest.approx(wanted[t])
        assert final[t].mixture.covariance()[0, 0] == pytest.approx(covariance[t, t])


@pytest.mark.parametrize('times', [1, 2, 5])
@pytest.mark.parametrize('window', [False, True])
def test_smoothing_backwards_agrees_with_the_dense_precision(modes, times, window):
    dynamics = LinearGaussianDynamics.constant_velocity([0.4, 0.7], 0.9)
    n = dynamics.state_dimension
    mixtures = tuple(modes(2.0, times=times))
    first = modes(1.0, seed=3, times=1, d=n)[0] if window else None
    sequence = ModeSequence(mixtures, dynamics, np.ones(times - (not window)), first)
    prior, likelihood = sequence.prior, sequence.likelihood
    filtered = PathSmoother(dynamics, max_trajectories=40)._filtered(sequence)
    nodes = filtered.paths.nodes
    states, factors = smoothed_paths(filtered.steps)
    forwards = path_gaussians(nodes, prior, likelihood)
    np.testing.assert_allclose(states, forwards.states, atol=1e-6)
    offset = filtered.paths.log_values - forwards.log_weights
    np.testing.assert_allclose(offset, offset[0], atol=1e-6)
    length = likelihood.times
    rng = np.random.default_rng(1)
    for path, factor in zip(nodes[:5], factors):
        dense = np.zeros((length, n, length, n))
        for t in range(length):
            precision = np.linalg.inv(sequence.layers[t].covariances[path[t]])
            d = len(precision)
            dense[t, :, t] = prior.precision.diagonal[t]
            dense[t, :d, t, :d] += precision
        for t, block in enumerate(prior.precision.lower):
            dense[t + 1, :, t], dense[t, :, t + 1] = block, block.T
        flat = dense.reshape(length * n, -1)
        inverse = np.linalg.inv(flat)
        blocks = inverse.reshape(length, n, length, n)
        assert (factor.times, factor.size) == (length, n)
        assert factor.log_determinant == pytest.approx(np.linalg.slogdet(flat)[1])
        x = rng.normal(size=(3, length, n))
        squares = np.square(factor.whiten(x)).reshape(3, -1).sum(1)
        np.testing.assert_allclose(
            squares, ((x.reshape(3, -1) @ flat) * x.reshape(3, -1)).sum(1), 1e-6
        )
        coloured = factor.solve_transposed(np.eye(length * n).reshape(-1, length, n))
        coloured = coloured.reshape(length * n, -1)
        np.testing.assert_allclose(coloured.T @ coloured, inverse, atol=1e-6)
        np.testing.assert_allclose(factor.whiten(factor.solve_transposed(x)), x, atol=1e-6)
        whole = factor.matrix()
        covariances = factor.inverse_blocks()
        for t in range(length):
            np.testing.assert_allclose(whole.diagonal[t], dense[t, :, t], atol=1e-6)
            np.testing.assert_allclose(covariances[t], blocks[t, :, t], atol=1e-6)
        for t in range(length - 1):
            np.testing.assert_allclose(whole.lower[t], prior.precision.lower[t], atol=1e-6)


def test_a_window_that_moves_on_computes_what_one_from_scratch_does(modes, walk):
    mixtures = modes(1.5, times=6)
    window = SlidingWindow(PathSmoother(walk, max_trajectories=8), fixed_lag=2)
    for t, mixture in enumerate(mixtures):
        found = window.step(t * 10**9, mixture).trajectories
    first = window._paths.steps[0].states
    scratch = PathSmoother(walk, max_trajectories=8)
    sequence = ModeSequence(tuple(mixtures[-2:]), walk, np.ones(2), first)
    wanted = scratch.smooth_sequence(sequence)
    np.testing.assert_allclose(found.states, wanted.states, atol=1e-12)
    np.testing.assert_allclose(found.weights, wanted.weights, atol=1e-12)
    np.testing.assert_allclose(found.log_joint, wanted.log_joint, atol=1e-12)


def test_dead_ends_are_forgotten(modes, walk):
    """What is left of the times before is what the paths at the end come from."""
    mixtures = modes(1.5, times=40)
    paths = FilteredPaths(walk, 8)
    for mixture in mixtures:
        paths.add(mixture, 1.0)
    nodes = paths.paths.nodes
    for t, step in enumerate(paths.steps[1:-1], 1):
        assert len(step) == len({tuple(x) for x in nodes[:, : t + 1].tolist()})
        assert len(step) == len(paths.steps[t + 1].passage.means)
    assert len(paths.steps[5]) < 8
