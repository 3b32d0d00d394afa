"""Probable paths: weights are those of the posterior, and those that are apart are kept."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from hmt_ros.inference import GaussianMixture
from hmt_ros.smoothing import LinearGaussianDynamics
from hmt_ros.smoothing.mixture_smoother import PathSmoother
from hmt_ros.smoothing.mode_sequence import ModeSequence, path_gaussians
from hmt_ros.smoothing.path_hypotheses import (
    FilteredPaths,
    PathHypotheses,
    distances,
    distances_of_paths,
    first_state,
    traced,
)


def probable_paths(mixtures, dynamics, intervals, count, points=None):
    paths = FilteredPaths(dynamics, count, points)
    for mixture, interval in zip(mixtures, [0.0, *intervals]):
        paths.add(mixture, interval)
    return paths.paths


FAST = LinearGaussianDynamics.constant_velocity([2.0, 2.0], 1.0)


def in_space(poses):
    """The variables (N, 2) of poses as one point (N, 1, 3)."""
    return np.pad(poses, ((0, 0), (0, 1)))[:, None]


@pytest.mark.parametrize('dynamics', [LinearGaussianDynamics.random_walk([0.5, 0.2]), FAST])
def test_weights_and_states_are_those_of_the_posterior(modes, dynamics):
    """Of all paths, against the Gaussians of whole paths."""
    mixtures = tuple(modes(1.5, times=4))
    found = probable_paths(mixtures, dynamics, np.ones(3), 81)
    assert sorted(map(tuple, found.nodes.tolist())) == list(itertools.product(range(3), repeat=4))
    sequence = ModeSequence(mixtures, dynamics, np.ones(3))
    exact = path_gaussians(found.nodes, sequence.prior, sequence.likelihood)
    offset = found.log_values - exact.log_weights
    np.testing.assert_allclose(offset, offset[0], atol=1e-6)
    assert (np.diff(found.log_values) <= 0).all()
    step = PathHypotheses.of_states(first_state(mixtures[0], dynamics))
    for mixture in mixtures[1:]:
        step = step.followed(mixture, dynamics, 1.0, 81)
    np.testing.assert_allclose(step.log_weights, found.log_values)
    np.testing.assert_allclose(step.states.means, exact.states[:, -1], atol=1e-6)
    last = [factor.inverse_blocks()[-1] for factor in exact.factors]
    np.testing.assert_allclose(step.states.covariances, last, atol=1e-6)


def test_a_path_does_not_turn_back_and_forth():
    """Two motions that part and cross: pairs of wide modes allow a change at every step."""
    times = np.arange(12)
    mixtures = tuple(
        GaussianMixture([0.5, 0.5], [[np.sin(t)], [-np.sin(t)]], [[[0.02]], [[0.02]]])
        for t in 0.5 * times
    )
    dynamics = LinearGaussianDynamics.constant_velocity([0.3], 2.0)
    found = probable_paths(mixtures, dynamics, np.full(11, 0.5), 8)
    for nodes in found.nodes[:2]:
        signs = np.where(nodes == 0, 1.0, -1.0)
        assert abs(signs[1:].sum()) == 11


def test_paths_that_are_apart_are_kept():
    """Two near modes weigh more than the third one, which is apart now, or was before."""
    here = GaussianMixture(
        [0.5, 0.49, 0.01],
        [[0.0, 0.0], [0.01, 0.0], [1.0, 0.0]],
        np.tile(0.01 * np.eye(2), (3, 1, 1)),
    )
    dynamics = LinearGaussianDynamics.random_walk([0.01, 0.01])
    heaviest = probable_paths((here,) * 3, dynamics, np.ones(2), 4)
    assert (heaviest.nodes < 2).all()
    apart = probable_paths((here,) * 3, dynamics, np.ones(2), 4, in_space)
    assert len(apart) == 4
    assert (apart.nodes == 2).all(1).any()
    # It is kept for what it was, when all that is seen agrees again.
    same = here[np.array([0])].normalised()
    later = probable_paths((here, here, same), dynamics, np.ones(2), 4, in_space)
    assert (later.nodes[:, :2] == 2).all(1).any()


def test_paths_are_traced_to_their_beginning(modes, walk):
    mixtures, steps = modes(2.0, times=4), []
    for mixture in mixtures:
        steps.append(
            steps[-1].followed(mixture, walk, 1.0, 5)
            if steps
            else PathHypotheses.of_states(first_state(mixture, walk))
        )
    nodes = traced(steps)
    whole = probable_paths(mixtures, walk, np.ones(3), 5)
    np.testing.assert_array_equal(nodes, whole.nodes)
    # From the second time on, the first nodes are paths until then.
    np.testing.assert_array_equal(steps[1].modes[traced(steps[1:])[:, 0]], nodes[:, 1])


def test_distances():
    points = np.zeros((3, 2, 3))
    points[1, 1, 0], points[2, 0, 2] = 3.0, 4.0
    gaps = distances(points)
    np.testing.assert_array_equal(gaps, [[0.0, 3.0, 4.0], [3.0, 0.0, 4.0], [4.0, 4.0, 0.0]])
    nodes = np.array([[0, 0], [0, 1], [2, 0]])
    np.testing.assert_array_equal(
        distances_of_paths(nodes, [gaps, gaps]), [[0.0, 3.0, 4.0], [3.0, 0.0, 4.0], [4.0, 4.0, 0.0]]
    )


def test_two_thousand_images_and_one(modes):
    walk = LinearGaussianDynamics.random_walk([0.5, 0.5])
    mixtures = modes(1.5, times=5) * 400
    found = PathSmoother(walk, max_trajectories=8, points=in_space).smooth(mixtures)
    assert found.times == 2000
    assert np.isfinite(found.states).all()
    (alone,) = (PathSmoother(walk, max_trajectories=8).smooth(mixtures[:1]),)
    assert alone.times == 1
    assert len(alone) == 3


def test_the_first_state_knows_what_the_dynamics_know():
    one = GaussianMixture([1.0], [[1.0]], [[[2.0]]])
    dynamics = replace(LinearGaussianDynamics.random_walk([1.0]), initial_precision=[[0.5]])
    state = first_state(one, dynamics)
    np.testing.assert_allclose(state.means, [[0.5]])
    np.testing.assert_allclose(state.covariances, [[[1.0]]])
    moving = first_state(GaussianMixture([1.0], [[1.0, 2.0]], [np.eye(2)]), FAST)
    np.testing.assert_allclose(moving.covariances[0], np.eye(4))


def test_paths_that_are_hardly_possible_stay_numbers():
    near = GaussianMixture([1.0], [[0.0]], [[[1e-4]]])
    both = GaussianMixture([0.5, 0.5], [[0.0], [50.0]], [[[1e-4]], [[1e-4]]])
    dynamics = LinearGaussianDynamics.random_walk([1e-3])
    found = PathSmoother(dynamics, max_trajectories=4).smooth([near, both, both])
    assert np.isfinite(found.states).all()
    assert found.weights[0] == pytest.approx(1.0)
