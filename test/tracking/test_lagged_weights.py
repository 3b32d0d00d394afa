"""Lagged weights of modes, compared with an enumeration of all histories."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from hmt_ros.image.background import BackgroundModel
from hmt_ros.inference import GaussianMixture
from hmt_ros.tracking import LaggedWeights, Tracker, TrackerSettings
from hmt_ros.tracking.weighting import pooled_origins

SMALL = TrackerSettings(
    candidates=8, max_hypotheses=4, estimate_shape=False, searched_chains=1, combinations=32
)


def mixture(weights):
    k = len(weights)
    return GaussianMixture(np.array(weights), np.arange(k)[:, None] * 1.0, np.ones((k, 1, 1)))


def forward(images, seed):
    """A forward recursion like the filter's, with random numbers.

    Each image has hypotheses that continue the previous modes, evidence, two facings with given
    masses, and modes that each represent a group of hypotheses.

    Returns:
        Of each image the weights of its modes, their origins, and the factors (K, N) and (N,) by
        which histories are multiplied, with the mode (N,) that stands for each hypothesis.
    """
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.ones(3))
    result = [(weights, np.empty((3, 0)), None)]
    for _ in range(images - 1):
        k, n, kept = len(weights), int(rng.integers(4, 7)), int(rng.integers(2, 5))
        moves = rng.uniform(1e-4, 1.0, (k, n))
        histories = np.log(weights)[:, None] + np.log(moves)
        log_priors = np.logaddexp.reduce(histories, axis=0)
        log_weights = log_priors - rng.uniform(0.0, 5.0, n)
        back, share = np.arange(n) % 2 == 0, rng.uniform(0.1, 0.9)
        for way, mass in ((back, share), (~back, 1.0 - share)):
            log_weights[way] += np.log(mass) - np.logaddexp.reduce(log_weights[way])
        factors = np.exp(log_weights - log_priors)
        owner = np.concatenate([np.arange(kept), rng.integers(0, kept, n - kept)])
        origins = pooled_origins(histories, log_weights, owner)
        weights = np.bincount(owner, np.exp(log_weights))
        weights = weights / weights.sum()
        result.append((weights, origins, (moves, factors, owner)))
    return result


def by_all_histories(recursion, t):
    """Weights of the modes of image t, as a sum over all paths through the images."""
    wanted = np.zeros(len(recursion[t][0]))
    counts = [len(recursion[0][0]), *(len(x[2][2]) for x in recursion[1:])]
    for path in itertools.product(*map(range, counts)):
        mode, share, passed = path[0], recursion[0][0][path[0]], [path[0]]
        for n, (_, _, (moves, factors, owner)) in zip(path[1:], recursion[1:]):
            share *= moves[mode, n] * factors[n]
            mode = int(owner[n])
            passed.append(mode)
        wanted[passed[t]] += share
    return wanted / wanted.sum()


@pytest.mark.parametrize('seed', range(5))
def test_weights_are_the_sum_over_all_histories(seed):
    recursion = forward(5, seed)
    lagged, found = LaggedWeights(3), []
    for t, (weights, origins, _) in enumerate(recursion):
        found += lagged.update(t, mixture(weights), origins)
    assert [one.stamp for one in found] == [0, 1]
    # Image 0 has left the window before the last one arrived.
    wanted = by_all_histories(recursion[:4], 0)
    assert found[0].posterior.weights == pytest.approx(wanted, abs=1e-12)
    found += lagged.finish()
    assert [one.stamp for one in found] == [0, 1, 2, 3, 4]
    for one in found[1:]:
        wanted = by_all_histories(recursion, one.stamp)
        assert one.posterior.weights == pytest.approx(wanted, abs=1e-12)
    # Only the newest image has the published weights.
    assert found[-1].posterior == mixture(recursion[-1][0]).normalised()
    assert np.abs(found[1].posterior.weights - recursion[1][0]).max() > 0.01


def test_what_is_kept_is_bounded_by_the_lag():
    lagged, keep = LaggedWeights(4), np.eye(2)
    for t in range(50):
        found = lagged.update(t, mixture([0.7, 0.3]), keep if t else np.empty((2, 0)))
        assert [one.stamp for one in found] == ([t - 4] if t >= 4 else [])
    assert [one.stamp for one in lagged.finish()] == [46, 47, 48, 49]


@pytest.mark.parametrize('origins', [np.ones((3, 2)), np.ones((2, 3)) / 3])
def test_origins_of_other_modes_are_refused(origins):
    lagged = LaggedWeights(2)
    lagged.update(0, mixture([0.5, 0.5]), np.empty((2, 0)))
    with pytest.raises(ValueError, match=r'wanted origins \(2, 2\), saw'):
        lagged.update(1, mixture([0.5, 0.5]), origins)


def test_the_weights_of_a_tracker(filmed, camera, human32, keypoints_of):
    """Compares a tracked rendered person with sums over all histories of four images."""
    poses, images, empty = filmed('reach', 0.6, camera)
    tracker = Tracker(human32, camera, SMALL, BackgroundModel.from_image(empty))
    start = GaussianMixture(np.ones(1), poses[:1], 0.02 * np.eye(human32.dimension)[None])
    tracker.reset(start)
    lagged, found, published, origins = LaggedWeights(3), [], [], []
    for i, image in enumerate(images):
        seen = keypoints_of(human32, poses[i], 2.0, i)
        posterior, _ = tracker.step(image, i * 100_000_000, keypoints=seen)
        assert tracker.estimate.origins.shape == (
            len(posterior),
            len(published[-1]) if published else 0,
        )
        assert not published or tracker.estimate.origins.sum(1) == pytest.approx(1.0, abs=1e-12)
        found += lagged.update(i, posterior, tracker.estimate.origins)
        published.append(posterior)
        origins.append(tracker.estimate.origins)
    assert [one.stamp for one in found] == list(range(len(images) - 3))
    changed = 0.0
    for one in found:
        t = one.stamp
        wanted = np.zeros(len(published[t]))
        for path in itertools.product(*(range(len(x)) for x in published[t : t + 4])):
            share = published[t + 3].weights[path[3]]
            for back in (3, 2, 1):
                share *= origins[t + back][path[back], path[back - 1]]
            wanted[path[0]] += share
        assert one.posterior.weights == pytest.approx(wanted, abs=1e-12)
        assert np.array_equal(one.posterior.means, published[t].means)
        changed = max(changed, np.abs(wanted - published[t].weights).max())
    assert changed > 1e-3
