"""Experts of one network: its outputs and derivatives, its files, and what it learns."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from hmt_learning.training.network_learning import LearningNetwork, first_layers
from hmt_ros.experts.network_experts import Layers, NetworkExperts
from hmt_ros.experts.training_pairs import Standardisation

needs_jax = pytest.mark.skipif(
    any(importlib.util.find_spec(x) is None for x in ('jax', 'optax')),
    reason='JAX and Optax, which learning needs, are not installed',
)
INPUTS, TARGETS, EXPERTS = 4, 3, 2


def model(seed: int = 0) -> NetworkExperts:
    """A model whose weights are random."""
    made = NetworkExperts(EXPERTS, units=8)
    rng = np.random.default_rng(seed)
    found = first_layers(INPUTS, 8, 2, EXPERTS * (2 + TARGETS), seed)
    found['last'] = found['last'] * np.float32(5.0)
    made.n_inputs_, made.n_outputs_ = INPUTS, TARGETS
    roots = rng.normal(size=(EXPERTS, TARGETS, TARGETS))
    made.set_parts(
        Layers(**found),
        Standardisation(rng.normal(size=INPUTS), rng.uniform(0.5, 2.0, INPUTS)),
        Standardisation(rng.normal(size=TARGETS), np.full(TARGETS, 0.7)),
        roots @ roots.transpose(0, 2, 1) + np.eye(TARGETS),
        rng.normal(size=(5, INPUTS)), 1.0,
    )  # fmt: skip
    return made


def test_jacobians_are_those_of_the_means():
    made, rng = model(), np.random.default_rng(1)
    at = rng.normal(size=(6, INPUTS))
    slopes = made.jacobians(at)
    step = 1e-3
    for i in range(INPUTS):
        ahead, behind = at.copy(), at.copy()
        ahead[:, i] += step
        behind[:, i] -= step
        found = (made.components(ahead).means - made.components(behind).means) / (2 * step)
        # Units whose slope changes within the step differ.
        close = np.isclose(slopes[..., i], found, atol=5e-3).mean()
        assert close > 0.9


def test_density_is_that_of_the_paper():
    made, rng = model(), np.random.default_rng(2)
    at, targets = rng.normal(size=(4, INPUTS)), rng.normal(size=(4, TARGETS))
    weights, means, covariances = made.predict_arrays(at)
    np.testing.assert_allclose(weights.sum(1), 1.0)
    off = targets[:, None] - means
    square = np.einsum('nmi,nmij,nmj->nm', off, np.linalg.inv(covariances), off)
    log = -0.5 * (square + np.linalg.slogdet(2 * np.pi * covariances)[1])
    wanted = np.log((weights * np.exp(log)).sum(1))
    np.testing.assert_allclose(made.log_density(at, targets), wanted, rtol=1e-9)


def test_support_falls_away_from_what_was_learned_from():
    made = model()
    near = made.support(np.zeros((1, INPUTS)))
    assert 0.0 < made.support(np.full((1, INPUTS), 30.0))[0] < 1e-3 < near[0] <= 1.0


def test_a_file_holds_it(tmp_path):
    made = model()
    read = NetworkExperts.load(made.save(tmp_path / 'model.npz'))
    at = np.random.default_rng(3).normal(size=(3, INPUTS))
    np.testing.assert_allclose(read.components(at).means, made.components(at).means, atol=5e-3)
    again = read.save(tmp_path / 'again.npz')
    assert again.read_bytes() == NetworkExperts.load(again).save(tmp_path / 'third').read_bytes()


def test_a_file_whose_layers_do_not_fit_is_refused(tmp_path):
    arrays = model().to_arrays()
    arrays['hidden'] = arrays['hidden'][:, :3]
    with pytest.raises(ValueError, match='product'):
        NetworkExperts.from_arrays(arrays)


def test_without_jax_learning_says_what_is_missing(monkeypatch):
    monkeypatch.setattr('hmt_learning.training.network_learning.find_spec', lambda _: None)
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match='pip install jax optax'):
        LearningNetwork(steps=1).fit(rng.normal(size=(30, 2)), rng.normal(size=(30, 2)))


@needs_jax
def test_both_branches_are_learned():
    """x = +-sin(3 r): two experts find one branch each, and how uncertain they are."""
    rng = np.random.default_rng(0)
    r = rng.uniform(-1.0, 1.0, (1500, 1))
    x = rng.choice([-1.0, 1.0], (1500, 1)) * (1.0 + np.sin(3.0 * r))
    x += 0.05 * rng.normal(size=x.shape)
    fitted = LearningNetwork(2, units=32, steps=800, batch=128, jitter=0.0, seed=1).fit(r, x)
    at = np.linspace(-0.4, 0.9, 9)[:, None]
    weights, means, _ = fitted.predict_arrays(at)
    np.testing.assert_allclose(weights, 0.5, atol=0.2)
    means = np.sort(means[:, :, 0], axis=1)
    branch = 1.0 + np.sin(3.0 * at[:, 0])
    np.testing.assert_allclose(means, np.stack([-branch, branch], axis=1), atol=0.15)
    again = LearningNetwork(2, units=32, steps=800, batch=128, jitter=0.0, seed=1).fit(r, x)
    assert np.array_equal(fitted.components(at).means, again.components(at).means)
