"""Choice of hypotheses against plain loops and full enumeration."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.special import logsumexp

from hmt_ros.tracking.selection import choose_hypotheses, distinct_hypotheses

SAME, CAP = 0.02, 0.3


def distance(a, b, same=SAME, cap=CAP):
    """Mean of the capped distances of the joints, less the distance that counts as zero."""
    gaps = [min(float(np.sqrt(((p - q) ** 2).sum())), cap) for p, q in zip(a, b)]
    return max(sum(gaps) / len(gaps) - same, 0.0)


def objective(joints, weights, chosen):
    """Expected distance from a hypothesis to the nearest of the chosen; CAP if none is chosen."""
    nearest = [min([CAP] + [distance(x, joints[c]) for c in chosen]) for x in joints]
    return float(np.dot(weights, nearest))


def greedy(joints, weights, count):
    """The heaviest, then whatever lowers the objective most, until nothing lowers it."""
    chosen = [int(np.argmax(weights))]
    while len(chosen) < count:
        now = objective(joints, weights, chosen)
        values = [objective(joints, weights, [*chosen, c]) for c in range(len(joints))]
        if now - min(values) <= 1e-13:
            break
        chosen.append(int(np.argmin(values)))
    return chosen


def hypotheses(n, seed, spread=0.15, joints=4):
    rng = np.random.default_rng(seed)
    return spread * rng.normal(size=(n, joints, 3)), rng.normal(0, 1.5, n)


def shares(log_weights):
    return np.exp(log_weights - logsumexp(log_weights))


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('count', [1, 3, 6])
def test_choice_is_greedy_on_the_expected_distance(seed, count):
    joints, log_weights = hypotheses(14, seed)
    kept = choose_hypotheses(joints, log_weights, count, same=0.02)
    assert list(kept.chosen) == greedy(joints, shares(log_weights), count)


@pytest.mark.parametrize('seed', range(4))
def test_choice_is_near_the_best_of_all_subsets(seed):
    """Given the first, three more gain at least 1 - 1/e of what the best three would."""
    joints, log_weights = hypotheses(10, seed)
    weights = shares(log_weights)
    kept = choose_hypotheses(joints, log_weights, 4, same=0.02)
    first = int(np.argmax(weights))
    base = objective(joints, weights, [first])
    best = min(
        objective(joints, weights, [first, *more]) for more in itertools.combinations(range(10), 3)
    )
    found = objective(joints, weights, list(kept.chosen))
    assert best <= found + 1e-15
    assert base - found >= (1 - np.exp(-1)) * (base - best)


def test_well_separated_groups_are_each_kept_once():
    """Three groups a metre apart: one of each is chosen, and their weights are summed."""
    rng = np.random.default_rng(0)
    heap = np.repeat(np.arange(3), 7)
    joints = np.zeros((21, 5, 3))
    joints[..., 0] = heap[:, None]
    joints += 0.002 * rng.normal(size=joints.shape)
    log_weights = rng.normal(0, 2.0, 21)
    kept = choose_hypotheses(joints, log_weights, 8, same=0.02)
    assert sorted(heap[kept.chosen]) == [0, 1, 2]
    assert np.array_equal(heap[kept.chosen][kept.owner], heap)
    for k, chosen in enumerate(kept.chosen):
        assert kept.log_weights[k] == pytest.approx(logsumexp(log_weights[heap == heap[chosen]]))


@pytest.mark.parametrize('seed', range(4))
def test_weights_go_to_the_nearest_that_is_kept(seed):
    joints, log_weights = hypotheses(25, seed, spread=0.1)
    kept = choose_hypotheses(joints, log_weights, 5, same=0.02)
    for i, owner in enumerate(kept.owner):
        gaps = [distance(joints[i], joints[c]) for c in kept.chosen]
        assert gaps[owner] == pytest.approx(min(min(gaps), CAP), abs=1e-12)
    assert np.array_equal(kept.owner[kept.chosen], np.arange(5))
    for k in range(5):
        assert kept.log_weights[k] == pytest.approx(logsumexp(log_weights[kept.owner == k]))
    assert logsumexp(kept.log_weights) == pytest.approx(logsumexp(log_weights))


def test_an_unlikely_hypothesis_far_away_beats_a_likely_one_nearby():
    """Three in a row: two thirds of the weight are 3 cm from the heaviest, the rest 30 cm."""
    joints = np.zeros((3, 2, 3))
    joints[1, :, 0], joints[2, :, 0] = 0.03, 0.30
    weights = np.array([0.5, 0.4, 0.1])
    kept = choose_hypotheses(joints, np.log(weights), 2, same=0.02)
    assert list(kept.chosen) == [0, 2]
    assert np.allclose(np.exp(kept.log_weights), [0.9, 0.1])


@pytest.mark.parametrize('seed', range(4))
def test_distinct_hypotheses_are_the_heaviest_of_their_neighbours(seed):
    joints, log_weights = hypotheses(30, seed, spread=0.1)
    same = 0.14
    kept = distinct_hypotheses(joints, log_weights, same)
    assert 1 < len(kept) < 30
    gaps = np.linalg.norm(joints[:, None] - joints[None], axis=3).mean(2)
    among = gaps[np.ix_(kept, kept)] + np.where(np.eye(len(kept)) > 0, np.inf, 0.0)
    assert among.min() >= same
    assert (np.diff(log_weights[kept]) <= 0).all()
    for i in set(range(30)) - set(kept):
        near = [k for k in kept if gaps[i, k] < same]
        assert max(log_weights[near]) >= log_weights[i]
