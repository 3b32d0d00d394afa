"""Basis functions and gates: derivatives, identities, and the bound, which must not decrease."""

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

from hmt_ros.experts.basis import LinearBasis, RadialBasis
from hmt_ros.experts.gates import (
    GAMMA_RATE,
    GAMMA_SHAPE,
    GaussianGates,
    SoftmaxGates,
    _Softmax,
    log_softmax,
)
from hmt_ros.experts.training_pairs import Standardisation
from hmt_ros.inference.clustering import squared_distances

P = 3


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture
def scaling():
    return Standardisation(np.array([0.3, -1.0, 2.0]), np.array([0.5, 2.0, 1.0]))


def bases(scaling, rng):
    return [LinearBasis(scaling), RadialBasis(scaling, rng.normal(size=(7, P)), 1.3)]


@pytest.mark.parametrize('which', [0, 1])
def test_jacobians_are_central_differences(scaling, rng, which):
    basis = bases(scaling, rng)[which]
    weights = rng.normal(size=(len(basis), 2))
    inputs = rng.normal(size=(5, P))
    steps = 1e-6 * np.eye(P)
    numeric = np.stack(
        [(basis.evaluate(inputs + s) - basis.evaluate(inputs - s)) @ weights / 2e-6 for s in steps],
        axis=2,
    )
    np.testing.assert_allclose(basis.jacobians(inputs, weights), numeric, atol=1e-8)


def test_kernels_are_gaussians_of_standardised_inputs(scaling, rng):
    basis = bases(scaling, rng)[1]
    inputs = rng.normal(size=(4, P))
    z = (inputs - scaling.centre) / scaling.scale
    expected = np.exp(-((z[:, None] - basis.centres) ** 2).sum(2) / (2 * 1.3**2))
    np.testing.assert_allclose(basis.evaluate(inputs)[:, 1:], expected, atol=1e-13)
    np.testing.assert_array_equal(basis.evaluate(inputs)[:, 0], 1.0)


def test_standardisation_has_mean_zero_and_variance_one(rng):
    values, weights = rng.normal(size=(50, P)) * [1.0, 5.0, 0.0] + 7.0, rng.uniform(size=50)
    z = Standardisation.of(values, weights).apply(values)
    np.testing.assert_allclose(weights @ z, 0.0, atol=1e-10)
    np.testing.assert_allclose(weights @ z**2 / weights.sum(), [1.0, 1.0, 0.0], atol=1e-10)


def test_common_scale_keeps_the_ratio_of_distances(rng):
    values = rng.normal(size=(50, P)) * [1.0, 5.0, 0.1]
    scaled = Standardisation.of(values, np.ones(50), 'common').apply(values)
    ratio = squared_distances(values, values)[0, 1:] / squared_distances(scaled, scaled)[0, 1:]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)


def softmax_problem(rng, samples=80, experts=3, count=4):
    features = rng.normal(size=(samples, count))
    h = rng.dirichlet(np.ones(experts), samples)
    weights = rng.uniform(0.5, 2.0, samples)
    return _Softmax(features, h * weights[:, None], weights), (experts, count)


def test_softmax_curvature_is_the_hessian(rng):
    problem, shape = softmax_problem(rng)
    weights = rng.normal(size=shape)

    def gradient(flat):
        gates = problem.likelihood(flat.reshape(shape))[1]
        return (
            (problem.targets - problem.sample_weights[:, None] * gates).T @ problem.features
        ).ravel()

    flat = weights.ravel()
    numeric = [(gradient(flat + e) - gradient(flat - e)) / 2e-6 for e in 1e-6 * np.eye(len(flat))]
    hessian = problem.curvature(problem.likelihood(weights)[1])
    np.testing.assert_allclose(hessian, -np.array(numeric), atol=1e-6)


def test_newton_finds_the_penalised_optimum(rng):
    problem, shape = softmax_problem(rng)
    precisions = np.array([0.1, 1.0, 3.0, 10.0])

    def objective(flat):
        weights = flat.reshape(shape)
        return -problem.likelihood(weights)[0] + 0.5 * (precisions * weights**2).sum()

    best = minimize(objective, np.zeros(12), method='BFGS', options={'gtol': 1e-7})
    found = problem.newton(np.zeros(shape), precisions, steps=20)
    assert objective(found.ravel()) <= best.fun + 1e-7
    np.testing.assert_allclose(found.ravel(), best.x, atol=1e-3)


def test_laplace_value_is_written_out(rng):
    problem, shape = softmax_problem(rng)
    precisions = np.array([0.1, 1.0, 3.0, 10.0])
    weights = rng.normal(size=shape)
    found = problem.laplace(weights, precisions)
    hessian = problem.curvature(problem.likelihood(weights)[1]) + np.diag(np.tile(precisions, 3))
    expected = (
        problem.likelihood(weights)[0]
        - 0.5 * (precisions * weights**2).sum()
        + 1.5 * np.log(precisions).sum()
        - 0.5 * np.linalg.slogdet(hessian)[1]
        + (GAMMA_SHAPE * np.log(precisions) - GAMMA_RATE * precisions).sum()
        - len(precisions) * (GAMMA_SHAPE * np.log(GAMMA_SHAPE / GAMMA_RATE) - GAMMA_SHAPE)
    )
    assert found.value == pytest.approx(expected, abs=1e-9)
    variances = np.diagonal(np.linalg.inv(hessian)).reshape(shape)
    np.testing.assert_allclose(found.determined, (1 - precisions * variances).sum(0), atol=1e-9)


def test_softmax_gates_climb_and_prune(scaling, rng):
    inputs = rng.normal(size=(300, P)) * scaling.scale + scaling.centre
    z = (inputs - scaling.centre) / scaling.scale
    h = np.exp(log_softmax(np.c_[4.0 * z[:, 0], -4.0 * z[:, 0]]))
    basis = RadialBasis(scaling, rng.normal(size=(30, P)), 2.0)
    gates = SoftmaxGates(basis, np.zeros((2, 31)), np.full(31, 0.1), -np.inf)
    features = gates.features(inputs)
    values = []
    for _ in range(30):
        gates, features = gates.learned(features, h, np.ones(300))
        values.append((h * gates.log_scores(features)).sum() + gates.penalty)
    assert np.diff(values).min() > -1e-8
    assert len(gates.basis) < 15
    np.testing.assert_allclose(features, gates.features(inputs), atol=1e-12)
    assert np.abs(np.exp(gates.log_scores(features)) - h).mean() < 0.05


def test_gaussian_gates_are_weighted_moments(scaling, rng):
    z, h = rng.normal(size=(100, P)), rng.dirichlet([1.0, 2.0], 100)
    weights = rng.uniform(0.5, 2.0, 100)
    gates = GaussianGates(
        scaling,
        np.log([0.5, 0.5]),
        np.zeros((2, P)),
        np.array([np.eye(P)] * 2),
        0.0,
        np.eye(P),
        0.0,
    )
    found, _ = gates.learned(z, h, weights)
    for i in range(2):
        share = h[:, i] * weights
        np.testing.assert_allclose(found.means[i], np.average(z, axis=0, weights=share))
        expected = np.cov(z.T, aweights=share, ddof=0)
        np.testing.assert_allclose(found.covariances[i], expected, atol=1e-12)
        log = multivariate_normal(found.means[i], expected).logpdf(z)
        log += np.log(share.sum() / weights.sum())
        np.testing.assert_allclose(found.log_scores(z)[:, i], log, atol=1e-10)
