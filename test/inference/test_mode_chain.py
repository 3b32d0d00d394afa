"""The chain of a filter's modes against an enumeration of all its paths."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hmt_ros.inference.mode_chain import reachable_origins
from hmt_ros.smoothing import Link, backward_weights, drawn_paths

COUNTS = (3, 4, 2, 5, 3)


def make_chain(counts=COUNTS, seed=0):
    rng = np.random.default_rng(seed)
    before = [0, *counts[:-1]]
    return [
        Link(
            rng.dirichlet(np.ones(k)), rng.dirichlet(np.full(m, 0.5), k) if m else np.empty((k, 0))
        )
        for k, m in zip(counts, before, strict=True)
    ]


def by_paths(links):
    """All paths and their probabilities, by equation (3), factor by factor."""
    paths = [*itertools.product(*(range(len(link.weights)) for link in links))]
    masses = []
    for path in paths:
        mass = links[-1].weights[path[-1]]
        for t in range(len(path) - 1, 0, -1):
            mass *= links[t].origins[path[t], path[t - 1]]
        masses.append(mass)
    return np.array(paths), np.array(masses)


def marginals(nodes, weights, counts=COUNTS):
    return [np.bincount(nodes[:, t], weights, minlength=k) for t, k in enumerate(counts)]


@pytest.mark.parametrize('seed', range(3))
def test_backward_weights_are_the_sums_over_all_paths(seed):
    links = make_chain(seed=seed)
    found = backward_weights(links)
    for weights, wanted in zip(found, marginals(*by_paths(links)), strict=True):
        np.testing.assert_allclose(weights, wanted, atol=1e-14)
    # The newest image has exactly the weights of the filter; the others do not.
    assert found[-1] is links[-1].weights
    assert np.abs(found[1] - links[1].weights).max() > 0.01


def test_one_image_is_a_chain():
    links = make_chain((4,))
    np.testing.assert_array_equal(backward_weights(links)[0], links[0].weights)
    nodes, weights = drawn_paths(links, 10, seed=0)
    np.testing.assert_allclose(marginals(nodes, weights, (4,))[0], links[0].weights, atol=1e-15)


@pytest.mark.parametrize('seed', range(3))
def test_paths_are_drawn_from_the_chain(seed):
    links = make_chain(seed=1)
    nodes, weights = drawn_paths(links, 4000, seed)
    assert 4000 <= len(nodes) == len(weights) < 4000 + COUNTS[0]
    assert weights.sum() == pytest.approx(1.0, abs=1e-12)
    oldest, wanted = np.bincount(nodes[:, 0], weights), backward_weights(links)[0]
    np.testing.assert_allclose(oldest, wanted, atol=1e-15, rtol=1e-12)
    for found, wanted in zip(marginals(nodes, weights), backward_weights(links), strict=True):
        np.testing.assert_allclose(found, wanted, atol=0.01)
    # This holds for whole paths, too, not only for their modes.
    every, masses = by_paths(links)
    names, drawn = np.unique(nodes, axis=0, return_inverse=True)
    shares = dict(zip(map(tuple, names), np.bincount(drawn.reshape(-1), weights), strict=True))
    likely = np.argsort(-masses)[:10]
    for path, mass in zip(every[likely], masses[likely], strict=True):
        assert shares[tuple(path.tolist())] == pytest.approx(mass, abs=0.01)


def test_few_paths_keep_the_weights_of_the_oldest_modes():
    """Each mode that is possible given later images begins a path, whatever its weight."""
    chain, origins = make_chain((5,)), np.array([[0.9, 0.0, 1e-9, 0.07, 0.03 - 1e-9]])
    nodes, shares = drawn_paths([*chain, Link(np.ones(1), origins)], 8, seed=0)
    assert set(nodes[:, 0].tolist()) == {0, 2, 3, 4}
    found = np.bincount(nodes[:, 0], shares)
    np.testing.assert_allclose(found, origins[0], atol=1e-15, rtol=1e-12)


def test_systematic_paths_are_nearer_than_independent_ones():
    """Of 128 paths from one mode through an even branch, half go each way, give or take one."""
    branch = Link(np.ones(1), np.array([[0.5, 0.5]]))
    links = [Link(np.array([0.5, 0.5]), np.empty((2, 0))), branch]
    for seed in range(20):
        nodes, _ = drawn_paths(links, 128, seed)
        assert abs(int(nodes[:, 0].sum()) - 64) <= 1


def test_the_same_seed_draws_the_same_paths():
    links = make_chain()
    one, same, other = (drawn_paths(links, 200, seed) for seed in (3, 3, 4))
    for a, b in zip(one, same, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (one[0] != other[0]).any()


def test_origins_that_nobody_has_told_are_those_within_reach():
    away = np.array([[0.1, 0.2, 0.9], [0.9, 0.9, 0.9], [0.9, 0.9, 0.1]])
    found = reachable_origins(away, np.array([0.2, 0.6, 0.2]), 0.25)
    # No mode is within reach of the second one, so all count as reachable.
    np.testing.assert_allclose(found, [[0.25, 0.75, 0.0], [0.2, 0.6, 0.2], [0.0, 0.0, 1.0]])
    # A mode without weight is not continued, however near it is.
    found = reachable_origins(away, np.array([0.4, 0.6, 0.0]), 0.25)
    np.testing.assert_allclose(found, [[0.4, 0.6, 0.0]] * 3)
