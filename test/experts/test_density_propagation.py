"""Propagation of mixtures, compared with samples, grids and closed forms."""

import numpy as np
import pytest

from hmt_ros.experts import JointExperts
from hmt_ros.experts.density_propagation import (
    linearised_products,
    propagate,
)
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.reduction import reduced


def random_mixture(rng, components, dimension, spread=2.0):
    factors = rng.normal(size=(components, dimension, 2 * dimension)) * 0.4
    return GaussianMixture(
        rng.dirichlet(np.ones(components)),
        spread * rng.normal(size=(components, dimension)),
        factors @ np.swapaxes(factors, 1, 2),
    )


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope='module')
def linear_model():
    """p(x_t | x_{t-1}, r_t) with states and targets of 2, observations of 1."""
    rng = np.random.default_rng(1)
    before, seen = rng.normal(size=(400, 2)), rng.normal(size=(400, 1))
    side = rng.integers(0, 2, 400)
    turned = before @ np.array([[0.8, -0.3], [0.3, 0.8]]) + seen * [1.0, -0.5]
    after = turned + side[:, None] * [3.0, 1.0] + 0.1 * rng.normal(size=(400, 2))
    return JointExperts(2, 'linear', n_starts=2).fit(np.hstack([before, seen]), after)


@pytest.fixture(scope='module')
def kernel_model():
    rng = np.random.default_rng(2)
    before = rng.uniform(-2.0, 2.0, (400, 1))
    after = np.sin(before) + rng.choice([-1.0, 1.0], (400, 1)) + 0.05 * rng.normal(size=(400, 1))
    return JointExperts(2, width=0.8, n_starts=2).fit(before, after)


@pytest.fixture(scope='module')
def previous():
    return GaussianMixture(
        [0.3, 0.7],
        [[0.0, 0.5], [-1.0, 0.2]],
        [[[0.04, 0.01], [0.01, 0.03]], [[0.02, 0.0], [0.0, 0.05]]],
    )


def samples_through(model, previous, observation, count, rng):
    """Draws of p(x_t | R_t): a previous state, then the model's mixture for it."""
    states = previous.sample(count, rng)
    inputs = np.hstack([states, np.broadcast_to(observation, (count, len(observation)))])
    weights, means, covariances = model.predict_arrays(inputs)
    chosen = (weights.cumsum(1) > rng.random((count, 1))).argmax(1)
    rows = np.arange(count)
    factors = np.linalg.cholesky(covariances[rows, chosen])
    noise = np.einsum('nij,nj->ni', factors, rng.normal(size=means[:, 0].shape))
    return means[rows, chosen] + noise


def test_products_agree_with_samples(linear_model, previous, rng):
    observation = np.array([0.4])
    found = linearised_products(linear_model, previous, observation)
    assert len(found) == len(previous) * 2
    draws = samples_through(linear_model, previous, observation, 200_000, rng)
    np.testing.assert_allclose(found.mean(), draws.mean(0), atol=0.03)
    np.testing.assert_allclose(found.covariance(), np.cov(draws.T), atol=0.06)
    # Draws have the same mean log density as samples of the mixture.
    own = found.log_density(found.sample(200_000, rng)).mean()
    assert found.log_density(draws).mean() == pytest.approx(own, abs=0.05)


def test_products_are_written_out(linear_model, previous):
    observation = np.array([0.4])
    found = linearised_products(linear_model, previous, observation)
    k = 0
    for w, m, s in zip(previous.weights, previous.means, previous.covariances, strict=True):
        point = np.append(m, observation)[None]
        gates, means, covariances = linear_model.predict_arrays(point)
        slopes = linear_model.jacobians(point)[0, :, :, :2]
        for i in range(2):
            assert found.weights[k] == pytest.approx(w * gates[0, i])
            np.testing.assert_allclose(found.means[k], means[0, i])
            expected = slopes[i] @ s @ slopes[i].T + covariances[0, i]
            np.testing.assert_allclose(found.covariances[k], expected)
            k += 1


def test_kernel_experts_agree_with_samples(kernel_model, rng):
    previous = GaussianMixture([0.5, 0.5], [[-1.0], [0.6]], [[[0.01]], [[0.02]]])
    found = propagate(kernel_model, previous, np.zeros(0), n_components=4)
    draws = samples_through(kernel_model, previous, np.zeros(0), 100_000, rng)
    edges = np.linspace(-3.0, 3.0, 61)
    counted = np.histogram(draws, edges, density=True)[0]
    middle = 0.5 * (edges[1:] + edges[:-1])[:, None]
    assert 0.05 * np.abs(counted - np.exp(found.log_density(middle))).sum() < 0.15


def test_rule_one_on_a_grid(linear_model):
    """The integral of rule (1) over a grid of previous states, in two dimensions."""
    before = GaussianMixture(
        [0.6, 0.4], [[0.0, 0.4], [-0.8, 0.1]], np.array([0.03, 0.05])[:, None, None] * np.eye(2)
    )
    observation = np.array([0.2])
    found = linearised_products(linear_model, before, observation)
    axis = np.linspace(-2.0, 2.0, 81)
    states = np.stack(np.meshgrid(axis, axis, indexing='ij'), axis=-1).reshape(-1, 2)
    shares = np.exp(before.log_density(states))
    shares /= shares.sum()
    inputs = np.hstack([states, np.broadcast_to(observation, (len(states), 1))])
    weights, means, covariances = linear_model.predict_arrays(inputs)
    at = found.sample(60, np.random.default_rng(3))
    whole = GaussianMixture(
        (shares[:, None] * weights).ravel(), means.reshape(-1, 2), covariances.reshape(-1, 2, 2)
    )
    np.testing.assert_allclose(found.log_density(at), whole.log_density(at), atol=0.05)


def test_rule_one_reduces_and_sorts(linear_model, previous):
    found = propagate(linear_model, previous, np.array([0.4]))
    assert len(found) == 2
    assert found.weights[0] >= found.weights[1]
    whole = linearised_products(linear_model, previous, np.array([0.4]))
    np.testing.assert_allclose(found.mean(), whole.mean(), atol=1e-10)
    np.testing.assert_allclose(found.covariance(), whole.covariance(), atol=1e-10)


def test_no_kernel_fires_in_the_first_frame(kernel_model):
    alone = GaussianMixture([0.4, 0.6], [[5.0], [7.0]], [[[1.0]], [[2.0]]])
    far = GaussianMixture([1.0], [[1e3]], [[[0.1]]])
    found = propagate(kernel_model, far, np.zeros(0), without_past=alone)
    np.testing.assert_allclose(found.means, alone.sorted().means)
    both = GaussianMixture([0.25, 0.75], [[0.3], [1e3]], [[[0.1]], [[0.1]]])
    found = propagate(kernel_model, both, np.zeros(0), without_past=alone, n_components=4)
    assert found.weights[found.means[:, 0] > 4.0].sum() == pytest.approx(0.75)


def test_dimensions_that_do_not_fit_are_named(linear_model, previous):
    with pytest.raises(ValueError, match='wanted 3 numbers together'):
        propagate(linear_model, previous, np.zeros(2))
    alone = GaussianMixture([1.0], [[0.0]], [[[1.0]]])
    with pytest.raises(ValueError, match='without_past has dimension 1, wanted 2'):
        propagate(linear_model, previous, np.zeros(1), without_past=alone)
    with pytest.raises(ValueError, match='0 components'):
        reduced(previous, 0)
