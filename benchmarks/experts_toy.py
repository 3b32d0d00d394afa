"""Mixtures of experts with known truth: the toy of BME fig. 2, an oracle, learning speed, a peer.

Functions return dicts of numbers with their targets.
"""

from __future__ import annotations

import importlib.util
import time
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp
from scipy.stats import norm

from benchmarks.machine import best_time
from hmt_ros.experts import (
    ConditionalDensity,
    ConditionalExperts,
    JointExperts,
    RelevanceVectorRegression,
)
from hmt_ros.inference import GaussianMixture

Array = NDArray[np.float64]

NOISE = 0.05
MODELS = {'conditional': ConditionalExperts, 'joint': JointExperts}
# Targets for the mean test log p(y | x) of M experts, and about that of one regression, nats.
WANTED = {3: 1.0, 5: 1.1, 7: 1.1}
WANTED_REGRESSION = 0.18


def toy(count: int, seed: int) -> tuple[Array, Array]:
    """Inputs x = y + 0.3 sin(2 pi y) + noise and targets y uniform in (0, 1), (N, 1) each."""
    rng = np.random.default_rng(seed)
    y = rng.uniform(0.0, 1.0, count)
    x = y + 0.3 * np.sin(2.0 * np.pi * y) + NOISE * rng.standard_normal(count)
    return x[:, None], y[:, None]


def true_log_density(inputs: Array, targets: Array) -> Array:
    """log p(y | x) of the toy, (N,), by quadrature over y."""
    grid = (np.arange(4000) + 0.5) / 4000

    def noise(y: Array, x: Array) -> Array:
        result: Array = norm.logpdf(x - y - 0.3 * np.sin(2.0 * np.pi * y), scale=NOISE)
        return result

    evidence = np.concatenate(
        [
            logsumexp(noise(grid, part[:, None]), axis=1) - np.log(len(grid))
            for part in np.array_split(inputs[:, 0], max(1, len(inputs) // 500))
        ]
    )
    return noise(targets[:, 0], inputs[:, 0]) - evidence


def toy_scores(
    seeds: int = 10, experts: tuple[int, ...] = (3, 5, 7), train: int = 250, test: int = 5000
) -> dict[str, Any]:
    """Mean test log density of both models, of one regression and of the truth, over seeds."""
    sets = [(toy(train, seed), toy(test, 1000 + seed)) for seed in range(seeds)]
    result: dict[str, Any] = {
        'seeds': seeds,
        'ceiling': float(np.mean([true_log_density(*after).mean() for _, after in sets])),
    }

    def score(make: Any) -> dict[str, Any]:
        begin = time.perf_counter()
        models = [make(seed).fit(*before) for seed, (before, _) in enumerate(sets)]
        seconds = (time.perf_counter() - begin) / len(sets)
        values = [
            model.log_density(*after).mean() for model, (_, after) in zip(models, sets, strict=True)
        ]
        return {
            'mean': float(np.mean(values)),
            'worst': float(np.min(values)),
            'best': float(np.max(values)),
            'seconds': seconds,
            'gates': float(np.mean([gate_extremes(model) for model in models])),
        }

    result['regression'] = score(lambda seed: RelevanceVectorRegression(seed=seed))
    result['regression']['wanted'] = WANTED_REGRESSION
    for name, model in MODELS.items():
        result[name] = {}
        for count in experts:
            entry = score(lambda seed, model=model, count=count: model(count, seed=seed))
            result[name][str(count)] = entry | {'wanted': WANTED.get(count)}
    return result


def gate_extremes(model: ConditionalDensity) -> float:
    """Mean weight of the heaviest branch where the toy has one branch; at best 1.

    Experts with nearly equal means count as one branch.
    """
    inputs = np.array([[-0.05], [0.0], [1.0], [1.05]])
    weights, means, _ = model.predict_arrays(inputs)
    heaviest = means[np.arange(len(inputs)), weights.argmax(1)]
    near = np.abs(means - heaviest[:, None])[:, :, 0] < 0.15
    return float((weights * near).sum(1).mean())


def branching(count: int, seed: int, inputs: int = 20, outputs: int = 32) -> tuple[Array, Array]:
    """A synthetic motion: inputs (N, p) that hardly distinguish two styles, and targets (N, D)."""
    shape = np.random.default_rng(0)
    into = shape.normal(size=(6, inputs))
    out = shape.normal(size=(8, outputs))
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    style, lean = rng.integers(0, 2, count), 0.5 * rng.normal(size=count)
    seen = np.c_[
        np.cos(phase), 0.03 * np.sin(phase) * (2 * style - 1), lean,
        np.cos(2 * phase), lean**2, np.cos(3 * phase),
    ]  # fmt: skip
    made = np.c_[
        np.cos(phase), np.sin(phase), style, lean,
        np.sin(2 * phase), style * np.cos(phase), np.cos(3 * phase), lean**2,
    ]  # fmt: skip
    return (
        seen @ into + 0.05 * rng.normal(size=(count, inputs)),
        made @ out + 0.1 * rng.normal(size=(count, outputs)),
    )


def learning(
    samples: int = 3000, experts: int = 5, outputs: int = 32, seconds: float = 1.0
) -> dict[str, Any]:
    """Time of learning, and of the prediction from one input."""
    train, test = branching(samples, 1, outputs=outputs), branching(1000, 2, outputs=outputs)
    result: dict[str, Any] = {'samples': samples, 'experts': experts, 'outputs': outputs}
    for name, model in MODELS.items():
        begin = time.perf_counter()
        learned = model(experts, seed=0).fit(*train)
        spent = time.perf_counter() - begin
        one = test[0][:1]
        result[name] = {
            'learning_s': spent,
            'learning_wanted_s': 60.0,
            'prediction_ms': 1e3
            * best_time(lambda m=learned, x=one: m.predict(x), seconds=seconds),
            'prediction_wanted_ms': 1.0,
            'log_density': float(learned.log_density(*test).mean()),
            'kernels': [len(expert.active) for expert in learned.experts_],
        }
    return result


def gaussian_mixture_oracle(
    seeds: int = 3, experts: int = 3, iterations: int = 50
) -> dict[str, Any] | str:
    """Linear joint experts against the conditional of scikit-learn's mixture of Gaussians."""
    if importlib.util.find_spec('sklearn') is None:
        return 'absent: scikit-learn is not installed'
    from sklearn.mixture import GaussianMixture as Peer

    worst = 0.0
    for seed in range(seeds):
        inputs, targets = branching(400, seed, inputs=4, outputs=3)
        points = np.hstack([inputs, targets])
        peer = Peer(experts, reg_covar=0.0, tol=0.0, max_iter=1, random_state=seed, warm_start=True)
        # Both continue from the peer's first iteration, with equally many iterations.
        with warnings.catch_warnings():
            warnings.simplefilter('ignore')
            peer.fit(points)
            start = peer.predict_proba(points)
            peer.set_params(max_iter=iterations + 1).fit(points)
        model = JointExperts(
            experts, 'linear', learning='maximum_likelihood', tolerance=-1.0,
            max_iterations=iterations,
        ).fit(inputs, targets, responsibilities=start)  # fmt: skip
        joint = GaussianMixture(peer.weights_, peer.means_, peer.covariances_)
        marginal = GaussianMixture(
            peer.weights_, peer.means_[:, :4], np.ascontiguousarray(peer.covariances_[:, :4, :4])
        )
        expected = joint.log_density(points) - marginal.log_density(inputs)
        worst = max(worst, float(np.abs(model.log_density(inputs, targets) - expected).max()))
    return {'seeds': seeds, 'largest_difference': worst, 'wanted': 1e-8}


def regression_peer(samples: int = 2000, outputs: int = 32) -> dict[str, Any]:
    """One regression and sklearn-rvm with the same kernel: time per output and likelihood.

    Ours learns all outputs at once and chooses the width of the kernel; the peer learns the first
    output with that width.
    """
    rng = np.random.default_rng(0)
    mixing = rng.normal(size=(4, outputs))
    inputs = rng.uniform(-1.7, 1.7, (samples + 1000, 3))
    signal = np.c_[
        np.sin(2.0 * inputs[:, 0]), inputs[:, 1] * inputs[:, 2], np.cos(inputs.sum(1)), inputs[:, 0]
    ]
    targets = signal @ mixing + 0.1 * rng.normal(size=(len(inputs), outputs))
    scaled = (inputs - inputs[:samples].mean(0)) / inputs[:samples].std(0)
    train, test = slice(0, samples), slice(samples, None)

    begin = time.perf_counter()
    ours = RelevanceVectorRegression().fit(scaled[train], targets[train])
    spent = time.perf_counter() - begin
    _, means, covariances = ours.predict_arrays(scaled[test])
    result: dict[str, Any] = {
        'samples': samples,
        'outputs': outputs,
        'per_output_s': spent / outputs,
        'width': ours.width_,
        'kernels': len(ours.experts_[0].active),
        'log_density': _first_output(targets[test], means[:, 0], covariances[:, 0, 0, 0]),
    }
    if importlib.util.find_spec('sklearn_rvm') is None:
        return result | {'peer': 'absent: sklearn-rvm is not installed'}
    from sklearn_rvm import EMRVR

    peer = EMRVR(kernel='rbf', gamma=0.5 / ours.width_**2)
    begin = time.perf_counter()
    peer.fit(scaled[train], targets[train, 0])
    spent = time.perf_counter() - begin
    mean, deviation = peer.predict(scaled[test], return_std=True)
    return result | {
        'peer': {
            'per_output_s': spent,
            'kernels': len(peer.relevance_vectors_),
            'log_density': _first_output(targets[test], mean[:, None], deviation**2),
        },
        'times_faster': spent / result['per_output_s'],
        'wanted': 100.0,
    }


def _first_output(targets: Array, means: Array, variances: Array) -> float:
    """Mean log density of the first output."""
    return float(norm.logpdf(targets[:, 0], means[:, 0], np.sqrt(variances)).mean())
