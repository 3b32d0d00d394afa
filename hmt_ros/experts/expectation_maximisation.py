"""Expectation maximisation of experts and gates (BME 2.2).

Every iteration raises the bound

    F = sum_i E_i(h) + G(h) - sum_n s_n sum_i h_ni log h_ni

which is minus the variational free energy (BME 24). E_i is the evidence of expert i for
responsibilities h (`sparse_bayes`), G the part of the gates (`gates`), and s are the sample
weights. The E-step takes an expectation over the weights W of the experts,

    h_ni ~ g_i(r_n) exp E_W log N(x_n; W_i' phi, O_i)                               (BME 13)

The expectation is D/2 phi' S_i phi below the logarithm at the mean weights. The M-steps raise E_i
and G.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hmt_ros.experts.gates import Gates, log_softmax
from hmt_ros.experts.sparse_bayes import SparseRegression, WeightedSums
from hmt_ros.experts.training_pairs import TrainingPairs
from hmt_ros.inference.arrays import Array, Index

# Function that learns an expert from its weighted sums and its previous state.
Learner = Callable[[WeightedSums, SparseRegression | None], SparseRegression]

# Minimum number of samples of an expert that is kept; the largest expert is always kept.
MIN_SAMPLES = 2.0


@dataclass(frozen=True, eq=False)
class EMState:
    """State of the iterations.

    Attributes:
        experts: M experts; none before the first M-step.
        gates: Gates of M experts.
        gate_features: (N, K') features for the gates.
        bound: F for the responsibilities of the last M-step, nats.
    """

    experts: tuple[SparseRegression, ...]
    gates: Gates
    gate_features: Array
    bound: float

    def without_others(self, kept: Index) -> EMState:
        """Return the state with only the experts `kept`."""
        experts = tuple(self.experts[int(i)] for i in kept)
        return EMState(experts, self.gates.of_experts(kept), self.gate_features, -np.inf)


def e_step(features: TrainingPairs, state: EMState) -> Array:
    """The E-step: responsibilities h (N, M), whose rows sum to 1.

    Args:
        features: Features phi of the samples with standardised targets.
    """
    log = state.gates.log_scores(state.gate_features)
    for i, one in enumerate(state.experts):
        factor = np.linalg.cholesky(one.noise)
        z = np.linalg.solve(factor, (features.targets - one.mean(features.inputs)).T)
        log_det = 2.0 * np.log(np.diagonal(factor)).sum()
        size = len(factor) * (np.log(2.0 * np.pi) + one.spread(features.inputs))
        log[:, i] -= 0.5 * ((z * z).sum(0) + log_det + size)
    return np.exp(log_softmax(log))


def m_step(features: TrainingPairs, state: EMState, shares: Array, learn: Learner) -> EMState:
    """The M-step: update experts and gates for responsibilities (N, M)."""
    weighted = shares * features.weights[:, None]
    count = shares.shape[1]
    old: tuple[SparseRegression | None, ...] = state.experts or (None,) * count
    experts = tuple(
        learn(WeightedSums.of(features.inputs, features.targets, weighted[:, i]), old[i])
        for i in range(count)
    )
    gates, gate_features = state.gates.learned(state.gate_features, shares, features.weights)
    scores = gates.log_scores(gate_features)
    choice = float((weighted * (scores - np.log(np.maximum(shares, np.finfo(float).tiny)))).sum())
    bound = sum(one.evidence for one in experts) + choice + gates.penalty
    return EMState(experts, gates, gate_features, bound)


def climb(
    features: TrainingPairs, state: EMState, learn: Learner, iterations: int, tolerance: float
) -> tuple[EMState, list[float]]:
    """Alternates E-steps and M-steps; prunes experts that have lost their samples.

    Args:
        features: Features phi of the samples with standardised targets.
        tolerance: Gain of an iteration below which the iterations end, nats per sample.

    Returns:
        The last state, and the bounds since the last pruning.
    """
    bounds = [state.bound]
    total = float(features.weights.sum())
    shares = e_step(features, state)
    for _ in range(iterations):
        samples = features.weights @ shares
        kept = np.flatnonzero(samples >= min(MIN_SAMPLES, float(samples.max())))
        if len(kept) < shares.shape[1]:
            state = state.without_others(kept)
            shares = e_step(features, state)
            bounds = []
        state = m_step(features, state, shares, learn)
        bounds.append(state.bound)
        if len(bounds) > 1 and bounds[-1] - bounds[-2] < tolerance * total:
            break
        shares = e_step(features, state)
    return state, bounds
