"""The embedded network against closed forms, and its paths against enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.reduction import merged_if_close
from hmt_ros.smoothing import LinearGaussianDynamics
from hmt_ros.smoothing.embedded_network import (
    diverse_subset,
    embedded_network,
    k_best_paths,
)

INTERVALS = np.array([0.5, 1.0, 0.5, 1.0])


def log_value(network, path):
    """Sum of the log values along a path (T,)."""
    links = [links[i, j] for links, i, j in zip(network.links, path[:-1], path[1:])]
    return sum(nodes[k] for nodes, k in zip(network.nodes, path)) + sum(links)


@pytest.fixture
def network(modes, walk):
    return embedded_network(modes(2.0), walk, INTERVALS)


@pytest.fixture
def every_path(network):
    paths = [np.array(p) for p in itertools.product(range(3), repeat=5)]
    return paths, np.array([log_value(network, p) for p in paths])


@pytest.mark.parametrize('d', [1, 2, 5])
def test_values_in_closed_form(modes, d):
    mixtures = modes(2.0, d=d, times=3, k=4)
    drift, diffusion = 0.02 - 0.1 * np.eye(d), 0.3 + np.eye(d)
    dynamics = LinearGaussianDynamics(drift, diffusion, d, np.zeros(d), np.zeros((d, d)))
    network = embedded_network(mixtures, dynamics, np.ones(2))
    for mixture, values in zip(mixtures, network.nodes):
        for i, value in enumerate(values):
            each = [
                w * multivariate_normal(m, s + mixture.covariances[i]).pdf(mixture.means[i])
                for w, m, s in zip(mixture.weights, mixture.means, mixture.covariances)
            ]
            assert value == pytest.approx(np.log(sum(each)))
    a, q = dynamics.transition(1.0)
    before, after = mixtures[:2]
    for i, j in itertools.product(range(4), repeat=2):
        spread = after.covariances[j] + a @ before.covariances[i] @ a.T + q
        expected = multivariate_normal(a @ before.means[i], spread).logpdf(after.means[j])
        assert network.links[0][i, j] == pytest.approx(expected)


def test_most_probable_paths_are_those_of_enumeration(network, every_path):
    paths, values = every_path
    found = k_best_paths(network, 1)
    assert len(found) == 9
    assert (np.diff(found.log_values) <= 0).all()
    for nodes, value in zip(found.nodes, found.log_values):
        same = [v for p, v in zip(paths, values) if (p[0], p[-1]) == (nodes[0], nodes[-1])]
        assert value == pytest.approx(max(same))
        assert log_value(network, nodes) == pytest.approx(value)


def test_k_best_paths_are_those_of_enumeration(network, every_path):
    paths, values = every_path
    found = k_best_paths(network, 4)
    assert len(found) == 36
    for ends in itertools.product(range(3), repeat=2):
        same = sorted((v for p, v in zip(paths, values) if (p[0], p[-1]) == ends), reverse=True)
        mine = (found.nodes[:, 0] == ends[0]) & (found.nodes[:, -1] == ends[1])
        np.testing.assert_allclose(found.log_values[mine], same[:4])
    everything = k_best_paths(network, 1000)
    np.testing.assert_allclose(everything.log_values, np.sort(values)[::-1])
    assert len(np.unique(everything.nodes, axis=0)) == 243
    with pytest.raises(ValueError, match='k must be'):
        k_best_paths(network, 0)


def test_a_diverse_subset_differs_more_than_the_best_paths(network):
    paths = k_best_paths(network, 27)
    best, diverse = diverse_subset(paths, 12, penalty=0.0), diverse_subset(paths, 12, penalty=5.0)
    np.testing.assert_allclose(best.log_values, np.sort(paths.log_values)[::-1][:12])
    assert diverse.log_values[0] == paths.log_values.max()
    assert len(np.unique(diverse.nodes, axis=0)) == 12

    def agreement(nodes):
        return (nodes[:, None] == nodes[None]).mean()

    assert agreement(diverse.nodes) < agreement(best.nodes) - 0.02
    assert len(diverse_subset(paths, 1000)) == 243


def test_one_time_and_one_mode(walk):
    one = GaussianMixture([3.0], [[1.0, 2.0]], [np.eye(2)])
    network = embedded_network([one], walk, np.zeros(0))
    assert k_best_paths(network, 1).nodes.tolist() == [[0]]


def test_merging_keeps_the_moments_and_leaves_no_close_pair(modes):
    for mixture in modes(0.6, k=6):
        found = merged_if_close(mixture, 2.0)
        assert len(found) < len(mixture)
        assert found.weights.sum() == pytest.approx(mixture.weights.sum())
        np.testing.assert_allclose(found.mean(), mixture.mean())
        np.testing.assert_allclose(found.covariance(), mixture.covariance())
        for i, j in itertools.combinations(range(len(found)), 2):
            offset = found.means[i] - found.means[j]
            middle = 0.5 * (found.covariances[i] + found.covariances[j])
            assert offset @ np.linalg.solve(middle, offset) >= 4.0
