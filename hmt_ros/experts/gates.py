"""Gates: the probability that an expert is responsible for an input (BME 2.2.2 and 2.2.3).

`SoftmaxGates` model only the choice of an expert:

    g(r) = softmax(V phi(r)),    V_ik ~ N(0, 1 / b_k),    b_k ~ Gamma(A, B)         (BME 16)

`GaussianGates` model the density of each expert's inputs:

    g_i(r) = a_i N(r; m_i, C_i) / sum_j a_j N(r; m_j, C_j)                          (BME 32)

Both learn from responsibilities h (N, M) and never lower

    sum_n s_n sum_i h_ni log g_i(r_n) + penalty

which is the gates' part of the bound that EM raises. The penalty of the softmax is its log prior
plus the Laplace approximation of the integral over V. The penalty of the Gaussians is an inverse
Wishart log prior.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.learned_file import (
    Arrays,
    check_covariances,
    nested,
    part,
)
from hmt_ros.core import elementary
from hmt_ros.experts.basis import Basis, LinearBasis, RadialBasis, basis_of
from hmt_ros.experts.training_pairs import Standardisation, TrainingPairs
from hmt_ros.inference import linear_algebra
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import inverse_triangular, product

# Gamma hyperprior of precisions: shape and rate (BME 2.2.2).
GAMMA_SHAPE, GAMMA_RATE = 1e-2, 1e-4
# Lower bound of precisions; without it, a gate that grows ever sharper would never converge.
MIN_PRECISION = 1e-5
# Effective number of parameters per expert below which a basis function may be pruned.
USELESS_PARAMETERS = 0.05
DAMPING_LIMIT = 1e10
NEWTON_STEPS = 3  # in one fit; the next M-step continues from the result
# Maximum number of kernels of new softmax gates; number of samples per kernel.
GATE_KERNELS, SAMPLES_PER_KERNEL = 60, 15


@dataclass(frozen=True, eq=False)
class SoftmaxGates:
    """Multinomial logistic regression with relevance determination.

    Attributes:
        basis: K basis functions phi.
        weights: (M, K) weights V.
        precisions: (K,) precisions b of the weights.
        penalty: Part of the bound that does not depend on the responsibilities, nats.
    """

    basis: Basis
    weights: Array
    precisions: Array
    penalty: float

    @classmethod
    def first(
        cls, experts: int, basis: Basis, pairs: TrainingPairs, scaling: Standardisation
    ) -> SoftmaxGates:
        """Return equal initial gates of M experts, with kernels of the experts' basis."""
        if experts == 1:
            basis = LinearBasis(scaling)
        elif isinstance(basis, RadialBasis):
            count = min(GATE_KERNELS, max(experts, len(pairs) // SAMPLES_PER_KERNEL))
            basis = basis.subset(np.arange(min(count, len(basis.centres))))
        count = len(basis)
        return cls(basis, np.zeros((experts, count)), np.full(count, 1e-1), -np.inf)

    def features(self, inputs: Array) -> Array:
        """Features (n, K) of inputs (n, p), for `log_scores` and `learned`."""
        return self.basis.evaluate(inputs)

    def log_scores(self, features: Array) -> Array:
        """log g, (n, M)."""
        return log_softmax(product(features, self.weights.T))

    def learned(
        self, features: Array, responsibilities: Array, sample_weights: Array
    ) -> tuple[SoftmaxGates, Array]:
        """Return improved gates, and the features (n, K') that remain after pruning."""
        if len(self.weights) == 1:
            return replace(self, penalty=0.0), features
        problem = _Softmax(features, responsibilities * sample_weights[:, None], sample_weights)
        same = problem.laplace(self.weights, self.precisions)
        moved = problem.settled(self.weights, self.precisions)
        updated = problem.settled(moved.weights, moved.better_precisions())
        best = max(same, moved, updated, key=lambda one: one.value)
        useless = best.determined < USELESS_PARAMETERS * len(self.weights)
        useless[0] = False
        kept = np.flatnonzero(~useless)
        basis = self.basis
        if useless.any() and isinstance(basis, RadialBasis):
            smaller = replace(problem, features=features[:, kept])
            fewer = smaller.settled(best.weights[:, kept], best.precisions[kept])
            if fewer.value >= best.value:
                best, features = fewer, features[:, kept]
                basis = basis.subset(kept[1:] - 1)
        return SoftmaxGates(basis, best.weights, best.precisions, best.penalty), features

    def of_experts(self, kept: Index) -> SoftmaxGates:
        """Gates of some of the experts."""
        return replace(self, weights=self.weights[kept])

    def arrays(self) -> Arrays:
        """Arrays for a file."""
        own = {'weights': self.weights, 'precisions': self.precisions}
        return own | nested('basis', self.basis.arrays())

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> SoftmaxGates:
        """Build the gates from `arrays`."""
        basis = basis_of(part('basis', arrays))
        return cls(basis, arrays['weights'], arrays['precisions'], 0.0)


@dataclass(frozen=True, eq=False)
class _SoftmaxFit:
    """Weights of the softmax, their precisions, and their part of the bound.

    Attributes:
        value: Part of the bound, nats.
        penalty: Part of the value that does not depend on the responsibilities, nats.
        determined: (K,) effective number of parameters of each function, 0 to M.
    """

    weights: Array
    precisions: Array
    value: float
    penalty: float
    determined: Array

    def better_precisions(self) -> Array:
        """Update the precisions by MacKay's fixed point with the hyperprior."""
        determined = np.maximum(self.determined, 0.0)
        precisions = (determined + 2.0 * GAMMA_SHAPE) / (
            (self.weights**2).sum(0) + 2.0 * GAMMA_RATE
        )
        return np.asarray(np.maximum(precisions, MIN_PRECISION))


@dataclass(frozen=True, eq=False)
class _Softmax:
    """Likelihood, gradient and Hessian of the softmax for given responsibilities.

    Attributes:
        features: (N, K).
        targets: (N, M) responsibilities times the weights of the samples.
        sample_weights: (N,).
    """

    features: Array
    targets: Array
    sample_weights: Array

    def likelihood(self, weights: Array) -> tuple[float, Array]:
        """sum s h log g, and the gates (N, M)."""
        log_gates = log_softmax(self.features @ weights.T)
        return float((self.targets * log_gates).sum()), np.exp(log_gates)

    def curvature(self, gates: Array) -> Array:
        """Minus the Hessian of the likelihood, (M K, M K)."""
        experts, count = gates.shape[1], self.features.shape[1]
        # sum_n s (diag(g) - g g') x (phi phi'); the second term is one matrix times its transpose.
        shared = (np.sqrt(self.sample_weights)[:, None] * gates)[:, :, None]
        shared = (shared * self.features[:, None]).reshape(len(gates), experts * count)
        result: Array = -(shared.T @ shared)
        for i in range(experts):
            own = slice(i * count, (i + 1) * count)
            scale = self.sample_weights * gates[:, i]
            result[own, own] += self.features.T @ (scale[:, None] * self.features)
        return result

    def settled(self, weights: Array, precisions: Array) -> _SoftmaxFit:
        """Return the fit after some Newton steps."""
        return self.laplace(self.newton(weights, precisions, NEWTON_STEPS), precisions)

    def newton(self, weights: Array, precisions: Array, steps: int) -> Array:
        """Take damped Newton steps; the ratio of true to predicted gain sets the damping."""
        shape = weights.shape
        prior = np.tile(precisions, shape[0])
        likelihood, gates = self.likelihood(weights)
        value = likelihood - 0.5 * float((precisions * weights**2).sum())
        damping, growth = 1e-3, 2.0
        fresh = True
        for _ in range(2 * steps):
            if fresh:
                gradient = ((self.targets - self.sample_weights[:, None] * gates).T) @ self.features
                gradient = (gradient - precisions * weights).ravel()
                hessian = self.curvature(gates)
                hessian[np.diag_indices_from(hessian)] += prior
                scale = np.diagonal(hessian).copy()
            damped = hessian.copy()
            damped[np.diag_indices_from(damped)] += damping * scale
            step = np.linalg.solve(damped, gradient)
            predicted = float(gradient @ step - 0.5 * step @ hessian @ step)
            if predicted < 1e-4 or damping > DAMPING_LIMIT:
                break
            trial = weights + step.reshape(shape)
            likelihood, trial_gates = self.likelihood(trial)
            trial_value = likelihood - 0.5 * float((precisions * trial**2).sum())
            ratio = (trial_value - value) / predicted
            fresh = ratio > 1e-3
            if fresh:
                weights, value, gates = trial, trial_value, trial_gates
                damping *= max(1.0 / 3.0, 1.0 - (2.0 * min(ratio, 2.0) - 1.0) ** 3)
                growth = 2.0
            else:
                damping *= growth
                growth *= 2.0
        return weights

    def laplace(self, weights: Array, precisions: Array) -> _SoftmaxFit:
        """Gates' part of the bound, by a Laplace approximation at the weights."""
        experts, count = weights.shape
        likelihood, gates = self.likelihood(weights)
        hessian = self.curvature(gates)
        hessian[np.diag_indices_from(hessian)] += np.tile(precisions, experts)
        factor = np.linalg.cholesky(hessian)
        half_log_det = float(np.log(np.diagonal(factor)).sum())
        penalty = -0.5 * float((precisions * weights**2).sum()) - half_log_det
        penalty += 0.5 * experts * float(np.log(precisions).sum())
        # Relative to the mode of the hyperprior, so that pruning a function costs nothing.
        hyper = (
            GAMMA_SHAPE * np.log(precisions * GAMMA_RATE / GAMMA_SHAPE)
            - GAMMA_RATE * precisions
            + GAMMA_SHAPE
        )
        penalty += float(hyper.sum())
        inverse = np.linalg.inv(factor)
        variances = (inverse**2).sum(0).reshape(experts, count)
        determined = experts - precisions * variances.sum(0)
        return _SoftmaxFit(weights, precisions, likelihood + penalty, penalty, determined)


@dataclass(frozen=True, eq=False)
class GaussianGates:
    """Gaussian density of the inputs of each expert.

    Attributes:
        standardisation: Maps inputs r to z.
        log_shares: (M,) log a.
        means: (M, p) m, standardised.
        covariances: (M, p, p) C, standardised.
        strength: Strength of the prior of C, in samples.
        target: (p, p) covariance preferred by the prior.
        penalty: Part of the bound that does not depend on the responsibilities, nats.
    """

    standardisation: Standardisation
    log_shares: Array
    means: Array
    covariances: Array
    strength: float
    target: Array
    penalty: float

    @cached_property
    def _whitening(self) -> tuple[Array, Array]:
        """Inverse Cholesky factors (M, p, p) of the covariances, and log |C| (M,)."""
        factors = linear_algebra.cholesky(self.covariances)
        log_dets = 2.0 * elementary.log(np.diagonal(factors, axis1=1, axis2=2)).sum(1)
        return inverse_triangular(factors), log_dets

    @classmethod
    def first(
        cls, experts: int, basis: Basis, pairs: TrainingPairs, scaling: Standardisation
    ) -> GaussianGates:
        """Initial gates of M experts."""
        p = pairs.inputs.shape[1]
        share = pairs.weights / pairs.weights.sum()
        z = scaling.apply(pairs.inputs)
        variances = np.maximum(share @ (z - share @ z) ** 2, 1e-6)
        # M experts divide the input space, so each covers 1/M of its volume.
        target = np.diag(variances) * experts ** (-2.0 / p)
        return cls(
            scaling,
            np.full(experts, -np.log(experts)),
            np.zeros((experts, p)),
            np.broadcast_to(target, (experts, p, p)).copy(),
            p + 1.0,
            target,
            0.0,
        )

    def features(self, inputs: Array) -> Array:
        """Standardised inputs (n, p)."""
        return self.standardisation.apply(inputs)

    def log_scores(self, features: Array) -> Array:
        """log a_i N(r; m_i, C_i), (n, M), unnormalised over experts, at standardised r (n, p)."""
        whiteners, log_dets = self._whitening
        result = np.empty((len(features), len(self.means)))
        for i, mean in enumerate(self.means):
            z = product(features - mean, whiteners[i].T)
            result[:, i] = (z * z).sum(1)
        size = features.shape[1] * elementary.log(2.0 * np.pi)
        return np.asarray(self.log_shares - 0.5 * (result + log_dets + size))

    def learned(
        self, features: Array, responsibilities: Array, sample_weights: Array
    ) -> tuple[GaussianGates, Array]:
        """Estimate weighted shares, means and covariances; only the covariances have a prior.

        a_i = sum_n h_ni / N                                                    (BME 45)
        m_i = sum_n h_ni r_n / sum_n h_ni                                       (BME 46)
        C_i = sum_n h_ni (r_n - m_i) (r_n - m_i)' / sum_n h_ni                  (BME 47)
        """
        share = responsibilities * sample_weights[:, None]
        total = share.sum(0)
        means = (share.T @ features) / total[:, None]
        covariances = np.empty_like(self.covariances)
        for i, mean in enumerate(means):
            offsets = features - mean
            scatter = offsets.T @ (share[:, i, None] * offsets)
            covariance = (scatter + self.strength * self.target) / (total[i] + self.strength)
            covariances[i] = 0.5 * (covariance + covariance.T)
        result = replace(
            self, log_shares=np.log(total / total.sum()), means=means, covariances=covariances
        )
        traces = np.einsum('mij,ji->m', np.linalg.inv(covariances), self.target)
        penalty = -0.5 * self.strength * float((result._whitening[1] + traces).sum())
        return replace(result, penalty=penalty), features

    def of_experts(self, kept: Index) -> GaussianGates:
        """Gates of some of the experts."""
        shares = self.log_shares[kept]
        return replace(
            self,
            log_shares=log_softmax(shares[None])[0],
            means=self.means[kept],
            covariances=self.covariances[kept],
        )

    def arrays(self) -> Arrays:
        """Arrays for a file."""
        return {
            'log_shares': self.log_shares,
            'means': self.means,
            'covariances': self.covariances,
            'strength': np.array(self.strength),
            'target': self.target,
        } | nested('basis', LinearBasis(self.standardisation).arrays())

    @classmethod
    def of_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> GaussianGates:
        """Build the gates from `arrays`; raises ValueError if covariances are invalid."""
        check_covariances('the covariances of gates', arrays['covariances'])
        return cls(
            basis_of(part('basis', arrays)).standardisation,
            arrays['log_shares'],
            arrays['means'],
            arrays['covariances'],
            float(arrays['strength']),
            arrays['target'],
            0.0,
        )


Gates = SoftmaxGates | GaussianGates


def log_softmax(scores: Array) -> Array:
    """Scores (n, M) minus the logarithm of the sum of their exponentials."""
    result: Array = scores - scores.max(axis=1, keepdims=True)
    result -= elementary.log(elementary.exp(result).sum(axis=1, keepdims=True))
    return result
