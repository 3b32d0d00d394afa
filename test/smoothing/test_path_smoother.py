"""Smoothing that ends with the paths: exact where all paths are kept."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics, SlidingWindow
from hmt_ros.smoothing.mixture_smoother import PathSmoother


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
