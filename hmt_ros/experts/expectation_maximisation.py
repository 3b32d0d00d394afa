"""Expectation maximisation of experts and gates (BME 2.2).

The bound that every iteration raises is

    F = sum_i E_i(h) + G(h) - sum_n s_n sum_i h_ni log h_ni

E_i is the evidence of expert i for responsibilities h (`sparse_bayes`), G what the gates say of h
(`gates`), s the weights of the samples. The E-step is h_ni proportional to g_i(r_n) exp E_W log
N(x_n; W_i' phi, O_i), where the expectation over weights lowers the logarithm by D/2 phi' S_i phi.
The M-steps climb E_i and G.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from hmt_ros.experts.gates import GaussianGates, SoftmaxGates, log_softmax
from hmt_ros.experts.sparse_bayes import SparseRegression, WeightedSums

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Gates = SoftmaxGates | GaussianGates
# An expert from its weighted sums and from what it was before.
Learner = Callable[[WeightedSums, SparseRegression | None], SparseRegression]

# An expert with fewer samples than this is empty; the largest never is.
LEAST_SAMPLES = 2.0


@dataclass(frozen=True, eq=False)
class EMData:
    """What every iteration needs, computed once.

    Attributes:
        features: (N, K) of the experts' candidates.
        targets: (N, D) standardised.
        weights: (N,) of samples.
    """

    features: Array
    targets: Array
    weights: Array


@dataclass(frozen=True, eq=False)
class EMState:
    """Where the iterations are.

    Attributes:
        experts: M of them, none before the first M-step.
        gates: of M experts.
        gate_features: (N, K') that the gates want.
        bound: F for the responsibilities that the M-step was given, nats.
    """

    experts: tuple[SparseRegression, ...]
    gates: Gates
    gate_features: Array
    bound: float

    def without_others(self, kept: Index) -> EMState:
        """The state of some of the experts."""
        experts = tuple(self.experts[int(i)] for i in kept)
        return EMState(experts, self.gates.of_experts(kept), self.gate_features, -np.inf)


def e_step(data: EMData, state: EMState) -> Array:
    """The E-step: h (N, M), rows sum to 1."""
    log = state.gates.log_scores(state.gate_features)
    for i, one in enumerate(state.experts):
        factor = np.linalg.cholesky(one.noise)
        z = solve_triangular(
            factor, (data.targets - one.mean(data.features)).T, lower=True, check_finite=False
        )
        log_det = 2.0 * np.log(np.diagonal(factor)).sum()
        size = len(factor) * (np.log(2.0 * np.pi) + one.spread(data.features))
        log[:, i] -= 0.5 * ((z * z).sum(0) + log_det + size)
    result: Array = np.exp(log_softmax(log))
    return result


def m_step(data: EMData, state: EMState, shares: Array, learn: Learner) -> EMState:
    """The M-step for responsibilities (N, M)."""
    weighted = shares * data.weights[:, None]
    count = shares.shape[1]
    old: tuple[SparseRegression | None, ...] = state.experts or (None,) * count
    experts = tuple(
        learn(WeightedSums.of(data.features, data.targets, weighted[:, i]), old[i])
        for i in range(count)
    )
    gates, gate_features = state.gates.learned(state.gate_features, shares, data.weights)
    scores = gates.log_scores(gate_features)
    choice = float((weighted * (scores - np.log(np.maximum(shares, np.finfo(float).tiny)))).sum())
    bound = sum(one.evidence for one in experts) + choice + gates.penalty
    return EMState(experts, gates, gate_features, bound)


def climb(
    data: EMData, state: EMState, learn: Learner, iterations: int, tolerance: float
) -> tuple[EMState, list[float], Array]:
    """E-steps and M-steps in turn; experts that are left without samples are pruned.

    Args:
        data: the samples.
        state: after an M-step.
        learn: the M-step of an expert.
        iterations: at most.
        tolerance: ends when an iteration gains less, nats per sample.

    Returns:
        The last state, the bounds since an expert was pruned, the last responsibilities (N, M).
    """
    bounds = [state.bound]
    total = float(data.weights.sum())
    shares = e_step(data, state)
    for _ in range(iterations):
        samples = data.weights @ shares
        kept = np.flatnonzero(samples >= min(LEAST_SAMPLES, float(samples.max())))
        if len(kept) < shares.shape[1]:
            state = state.without_others(kept)
            shares = e_step(data, state)
            bounds = []
        state = m_step(data, state, shares, learn)
        bounds.append(state.bound)
        if len(bounds) > 1 and bounds[-1] - bounds[-2] < tolerance * total:
            break
        shares = e_step(data, state)
    return state, bounds, shares
