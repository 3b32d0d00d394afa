"""Sparse Bayesian regression, compared with the dense marginal likelihood."""

import numpy as np
import pytest
from scipy.optimize import minimize

from hmt_ros.experts.sparse_bayes import (
    RegressionPrior,
    SparseRegression,
    WeightedSums,
    _GreedyState,
    maximise_evidence,
    posterior,
    with_best_noise,
)

N, D = 60, 3


@pytest.fixture(scope='module')
def problem():
    """Features (N, K), targets (N, D), weights (N,) with correlated noise."""
    rng = np.random.default_rng(0)
    r = rng.uniform(-3.0, 3.0, (N, 1))
    mixing = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]])
    signal = np.c_[np.sin(r), np.cos(2.0 * r), r**2 / 9.0]
    targets = signal + 0.1 * rng.normal(size=(N, D)) @ mixing
    features = np.c_[np.ones(N), np.exp(-0.5 * ((r - r[::2].T) / 0.6) ** 2)]
    return features, targets, rng.uniform(0.1, 2.0, N)


@pytest.fixture(scope='module')
def prior():
    return RegressionPrior(2.0, 2e-3 * np.eye(D))


def dense_evidence(features, targets, weights, noise, active, precisions, prior):
    """The weighted evidence with the (N, N) covariance between samples."""
    phi = features[:, active]
    between = np.diag(1.0 / weights) + (phi / precisions) @ phi.T
    total = weights.sum()
    inside = targets.T @ np.linalg.solve(between, targets) + prior.scale
    return -0.5 * (
        D * (np.linalg.slogdet(between)[1] + np.log(weights).sum())
        + D * total * np.log(2.0 * np.pi)
        + (total + prior.strength) * np.linalg.slogdet(noise)[1]
        + np.trace(np.linalg.solve(noise, inside))
    )


def test_evidence_is_the_dense_marginal_likelihood(problem, prior):
    features, targets, weights = problem
    found = maximise_evidence(WeightedSums.of(*problem), prior)
    assert 3 < len(found.active) < 25
    expected = dense_evidence(
        features, targets, weights, found.noise, found.active, found.precisions, prior
    )
    assert found.evidence == pytest.approx(expected, abs=1e-8)


def test_posterior_is_the_dense_one(problem, prior):
    features, targets, weights = problem
    found = maximise_evidence(WeightedSums.of(*problem), prior)
    phi = features[:, found.active]
    inner = np.diag(found.precisions) + phi.T @ (weights[:, None] * phi)
    np.testing.assert_allclose(found.covariance @ inner, np.eye(len(inner)), atol=1e-8)
    expected = np.linalg.solve(inner, phi.T @ (weights[:, None] * targets))
    np.testing.assert_allclose(found.weights, expected, atol=1e-8)
    np.testing.assert_allclose(found.mean(features), phi @ expected, atol=1e-8)
    spread = np.einsum('ni,ij,nj->n', phi, np.linalg.inv(inner), phi)
    np.testing.assert_allclose(found.spread(features), spread, atol=1e-10)


def test_every_greedy_step_gains_what_it_promises(problem, prior):
    sums = WeightedSums.of(*problem)
    found = maximise_evidence(sums, prior, rounds=2)
    state = _GreedyState(sums, found)
    kinds = set()
    before = found.evidence
    for _ in range(60):
        size = len(state.active)
        _, gain, _ = state._best()
        if not state.step(1e-6):
            break
        kinds.add(len(state.active) - size)
        after = posterior(sums, state.active, state.precisions, found.noise, prior).evidence
        assert after - before == pytest.approx(gain, abs=1e-8)
        before = after
    assert kinds == {-1, 0, 1}


def test_no_change_of_one_precision_improves_the_result(problem, prior):
    features, targets, weights = problem
    sums = WeightedSums.of(*problem)
    found = maximise_evidence(sums, prior, tolerance=1e-10, rounds=2000)

    def evidence(precisions, active):
        return dense_evidence(features, targets, weights, found.noise, active, precisions, prior)

    for place in range(len(found.active)):
        for factor in (0.98, 1.02):
            changed = found.precisions.copy()
            changed[place] *= factor
            assert evidence(changed, found.active) < found.evidence + 1e-7
        rest = np.delete(np.arange(len(found.active)), place)
        assert evidence(found.precisions[rest], found.active[rest]) < found.evidence
    for extra in np.setdiff1d(np.arange(features.shape[1]), found.active):
        for precision in np.logspace(-4, 6, 21):
            value = evidence(np.append(found.precisions, precision), np.append(found.active, extra))
            assert value < found.evidence + 1e-4


def test_greedy_reaches_the_optimum_over_all_precisions(problem, prior):
    features, targets, weights = problem
    found = maximise_evidence(WeightedSums.of(*problem), prior, tolerance=1e-8, rounds=2000)
    everything = np.arange(features.shape[1])

    def objective(log_precisions):
        return -dense_evidence(
            features, targets, weights, found.noise, everything, np.exp(log_precisions), prior
        )

    start = np.full(len(everything), 12.0)
    start[found.active] = np.log(found.precisions)
    best = minimize(objective, start, method='L-BFGS-B', bounds=[(-12.0, 16.0)] * len(start))
    assert found.evidence > -best.fun - 0.05


def test_noise_maximises_the_evidence(problem, prior):
    features, targets, weights = problem
    sums = WeightedSums.of(*problem)
    found = with_best_noise(sums, maximise_evidence(sums, prior), prior)
    rng = np.random.default_rng(1)
    for _ in range(20):
        change = 0.01 * rng.normal(size=(D, D))
        noise = (np.eye(D) + change) @ found.noise @ (np.eye(D) + change).T
        other = dense_evidence(
            features, targets, weights, noise, found.active, found.precisions, prior
        )
        assert other < found.evidence


def test_weight_two_counts_like_two_samples(problem, prior):
    features, targets, _ = problem
    weights = np.ones(N)
    weights[:10] = 2.0
    once = maximise_evidence(WeightedSums.of(features, targets, weights), prior)
    rows = np.concatenate([np.arange(N), np.arange(10)])
    twice = maximise_evidence(
        WeightedSums.of(features[rows], targets[rows], np.ones(len(rows))), prior
    )
    np.testing.assert_array_equal(once.active, twice.active)
    np.testing.assert_allclose(once.weights, twice.weights, rtol=1e-6, atol=1e-9)
    assert once.evidence == pytest.approx(twice.evidence, abs=1e-7)


def test_equal_candidates_are_taken_once(problem, prior):
    features, targets, weights = problem
    doubled = np.hstack([features, features])
    found = maximise_evidence(WeightedSums.of(doubled, targets, weights), prior)
    active = found.active % features.shape[1]
    assert len(set(active.tolist())) == len(active)
    assert np.isfinite(found.evidence)


def test_tails_of_kernels_get_no_weight_without_bounds(prior):
    """Kernels with only tails in the data would be arbitrary near their centres."""
    rng = np.random.default_rng(1)
    r = rng.uniform(0.0, 1.0, (200, 1))
    centres = np.array([[4.0, 5.0, 6.0, 8.0]])
    targets = np.exp(2.0 * r) @ np.ones((1, D)) + 0.01 * rng.normal(size=(200, D))
    targets -= targets.mean(0)
    sums = WeightedSums.of(np.exp(-0.5 * (r - centres) ** 2), targets, np.ones(200))
    found = maximise_evidence(sums, prior)
    at = np.linspace(-2.0, 10.0, 50)[:, None]
    said = found.mean(np.exp(-0.5 * (at - centres) ** 2))
    assert np.abs(said).max() < 100.0 * targets.std()


def test_targets_that_are_pure_noise_need_no_function(prior):
    rng = np.random.default_rng(3)
    features = np.exp(-0.5 * (rng.normal(size=(200, 1)) - rng.normal(size=40)) ** 2)
    found = maximise_evidence(
        WeightedSums.of(features, rng.normal(size=(200, D)), np.ones(200)), prior
    )
    assert len(found.active) <= 2
    np.testing.assert_allclose(found.noise, np.eye(D), atol=0.25)


def test_climbs_monotonously_from_any_start(problem, prior):
    sums = WeightedSums.of(*problem)
    found = maximise_evidence(sums, prior, rounds=1, steps=1)
    values = [found.evidence]
    for _ in range(40):
        found = maximise_evidence(sums, prior, found, rounds=1, steps=1)
        values.append(found.evidence)
    assert np.diff(values).min() > -1e-9


def test_prediction_covers_what_it_should():
    """Coverage of 90 % regions for new samples with known noise, over repeated training sets."""
    rng = np.random.default_rng(5)
    inside = []
    for _ in range(20):
        r = rng.uniform(-3.0, 3.0, (260, 1))
        targets = np.sin(2.0 * r) + 0.2 * rng.normal(size=r.shape)
        features = np.c_[np.ones(len(r)), np.exp(-0.5 * ((r - np.linspace(-3, 3, 30)) / 0.5) ** 2)]
        found: SparseRegression = maximise_evidence(
            WeightedSums.of(features[:60], targets[:60], np.ones(60)),
            RegressionPrior(2.0, 0.02 * np.eye(1)),
        )
        scale = np.sqrt(found.noise[0, 0] * (1.0 + found.spread(features[60:])))
        inside.append(np.abs(targets[60:] - found.mean(features[60:]))[:, 0] < 1.645 * scale)
    assert 0.85 < np.mean(inside) < 0.95
