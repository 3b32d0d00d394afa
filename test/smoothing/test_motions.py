"""Motions: distances of paths by definition, short differences, and evidence moments."""

from __future__ import annotations

import numpy as np
import pytest

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.reduction import merged
from hmt_ros.smoothing.motions import (
    MAX_SPAN_DISTANCE,
    SAME_MOTION_DISTANCE,
    SPAN_TIME,
    SPANS_PER_MOMENT,
    evidence_of_motions,
    grouped,
    path_distances,
)

RATE = 30


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def by_definition(nodes, points, stamps):
    """Equation (1) by loops over pairs, spans and joints, with the maximum over spans.

    Also returns the mean over all spans, without a limit.
    """
    ages = [(stamps[-1] - stamp) * 1e-9 for stamp in stamps]
    of_span = [int(np.floor(age / SPAN_TIME + 1e-3)) for age in ages]
    result, means = np.zeros((2, len(nodes), len(nodes)))
    for a in range(len(nodes)):
        for b in range(len(nodes)):
            apart = {}
            for span in set(of_span):
                times = [t for t, own in enumerate(of_span) if own == span]
                places = [
                    np.mean([points[t][nodes[path, t]] for t in times], axis=0) for path in (a, b)
                ]
                far = np.sqrt(np.square(places[0] - places[1]).sum(1).mean())
                apart[span] = far
            means[a, b] = sum(apart.values()) / len(apart)
            oldest = max(apart)
            for end in range(min(SPANS_PER_MOMENT - 1, oldest), oldest + 1):
                some = [apart[s] for s in range(end - SPANS_PER_MOMENT + 1, end + 1) if s in apart]
                some = [min(far, MAX_SPAN_DISTANCE) for far in some]
                result[a, b] = max(result[a, b], sum(some) / max(len(some), 1))
    return result, means


@pytest.mark.parametrize(
    'stamps',
    [
        [0],
        [0, 0.05],
        np.arange(9) / RATE,
        np.arange(40) / RATE,
        np.arange(12) / 10,
        np.arange(4.0),
        np.arange(5) / 2,
        np.cumsum([0.0, 0.03, 0.2, 0.01, 0.5, 0.1, 0.03, 0.03, 1.2, 0.4, 0.1, 0.03]),
    ],
)
def test_distances_are_those_of_the_definition(rng, stamps):
    stamps = [10**18 + round(1e9 * t) for t in stamps]
    points = [0.04 * rng.normal(size=(3, 2, 3)) for _ in stamps]
    nodes = rng.integers(0, 3, (6, len(stamps)))
    nodes[3, 0] = (nodes[2, 0] + 1) % 3
    nodes[3, 1:] = nodes[2, 1:]
    found = path_distances(nodes, points, stamps)
    for one, wanted in zip(found, by_definition(nodes, points, stamps), strict=True):
        np.testing.assert_allclose(one, wanted, atol=1e-14)
        np.testing.assert_array_equal(one, one.T)
        assert one.max() > 0.0


def two_paths(images, away, some):
    """Distance of two paths that differ by `away` in some images and are equal in others."""
    points = [np.array([[[0.0, 0.0, 0.0]], [[away, 0.0, 0.0]]])] * images
    nodes = np.zeros((2, images), dtype=np.intp)
    nodes[1, list(some)] = 1
    stamps = [round(1e9 * t / RATE) for t in range(images)]
    return float(path_distances(nodes, points, stamps)[0][0, 1])


@pytest.mark.parametrize('images', [14, 16, 17, 18, 19, 45, 60])
@pytest.mark.parametrize('away', [0.05, 0.1, 0.15, 9.0])
def test_what_flickers_is_absorbed(images, away):
    """A path 150 mm away for less than 0.1 s, or at any distance within one span, is merged.

    The oldest images of a window, less than a span, are an exception: a motion may end there.
    """
    newest = [range(images - 5 * k - 5, images - 5 * k) for k in range(images // 5)]
    for first in range(images % 5, images - 1):
        some = {first, first + 1}
        if away <= 0.15 or any(some < set(span) for span in newest):
            assert two_paths(images, away, some) <= SAME_MOTION_DISTANCE + 1e-12


@pytest.mark.parametrize('images', [16, 17, 18, 19, 60])
def test_two_that_part_and_meet_again_are_two(images):
    """They differ by 150 mm for 0.3 s, at any time."""
    for first in range(images - 8):
        assert two_paths(images, 0.15, range(first, first + 9)) > SAME_MOTION_DISTANCE
    # With a smaller constant difference they are one motion.
    assert (
        two_paths(images, 0.029, range(images))
        <= SAME_MOTION_DISTANCE
        < two_paths(images, 0.031, range(images))
    )


def test_in_a_window_of_one_image_every_mode_is_a_motion():
    assert two_paths(1, 0.031, {0}) > SAME_MOTION_DISTANCE >= two_paths(1, 0.029, {0})


def test_motions_are_numbered_by_weight_and_have_all_of_it():
    places = np.array([0.0, 0.5, 0.51, 1.0, 1.02, 2.0, 0.04])
    weights = np.array([0.05, 0.2, 0.15, 0.31, 0.23, 0.01, 0.05])
    distances = np.abs(places[:, None] - places)
    found = grouped(weights, distances, distances, most=8, least=0.02)
    assert found.tolist() in ([2, 1, 1, 0, 0, 0, 3], [3, 1, 1, 0, 0, 0, 2])
    # At most two motions, the heaviest; all other paths belong to the nearer one.
    found = grouped(weights, distances, distances, most=2, least=0.02)
    assert found.tolist() == [1, 1, 1, 0, 0, 0, 1]
    np.testing.assert_allclose(np.bincount(found, weights), [0.55, 0.45])
    assert set(grouped(weights, distances, distances, most=8, least=0.0)) == set(range(5))
    # The first path is always a motion.
    assert set(grouped(weights, distances, distances, most=8, least=0.9)) == {0}


def test_a_path_that_is_no_motion_belongs_to_what_it_is_near_for_longer():
    """It belongs to the second path for a second, then to the third, never to the first."""
    points = [np.array([[[0.0] * 3], [[1.0] * 3], [[2.0] * 3]])] * 60
    nodes = np.zeros((4, 60), dtype=np.intp)
    nodes[1], nodes[2], nodes[3, :35], nodes[3, 35:] = 1, 2, 1, 2
    stamps = [round(1e9 * t / RATE) for t in range(60)]
    found = grouped(
        np.array([0.5, 0.2, 0.29, 0.01]), *path_distances(nodes, points, stamps), 8, 0.02
    )
    assert found.tolist() == [0, 2, 1, 2]


def test_what_flickers_far_away_does_not_leave_its_motion():
    """It is 1 m away for 1/6 s; another motion on that side is always 40 mm away."""
    points = [np.array([[[0.0, 0.0, 0.0]], [[0.04, 0.0, 0.0]], [[1.0, 0.0, 0.0]]])] * 16
    nodes = np.zeros((3, 16), dtype=np.intp)
    nodes[1], nodes[2, 6:11] = 1, 2
    distances = path_distances(nodes, points, [round(1e9 * t / RATE) for t in range(16)])
    assert grouped(np.array([0.5, 0.4, 0.1]), *distances, 8, 0.02).tolist() == [0, 1, 0]


def test_evidence_has_the_moments_of_the_modes(rng):
    counts, weights = (3, 1, 4), rng.dirichlet(np.ones(6))
    nodes = np.stack([rng.integers(0, k, 6) for k in counts], axis=1)
    labels = np.array([0, 1, 0, 2, 1, 0])
    mixtures = []
    for k in counts:
        factors = rng.normal(size=(k, 2, 2))
        covariances = factors @ factors.swapaxes(1, 2) + np.eye(2)
        mixtures.append(GaussianMixture(np.ones(k), rng.normal(size=(k, 2)), covariances))
    found = evidence_of_motions(nodes, weights, labels, mixtures)
    for t, mixture in enumerate(mixtures):
        for m in range(3):
            own = np.where(labels == m, weights, 0.0)
            mass = np.bincount(nodes[:, t], own, minlength=counts[t])
            heavy = GaussianMixture(mass, mixture.means, mixture.covariances)
            wanted = merged(heavy, np.ones((counts[t], 1)))
            np.testing.assert_allclose(found.means[m, t], wanted.means[0], atol=1e-12)
            np.testing.assert_allclose(found.covariances[m, t], wanted.covariances[0], atol=1e-12)
            within = np.tensordot(mass / mass.sum(), mixture.covariances, 1)
            np.testing.assert_allclose(
                found.disagreements[m, t], wanted.covariances[0] - within, atol=1e-12
            )
