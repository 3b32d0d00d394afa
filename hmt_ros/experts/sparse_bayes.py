"""Sparse Bayesian regression with several outputs, by greedy evidence maximisation (BME 2.2.2).

    X = Phi W + E,   E_n ~ N(0, O / h_n),   W ~ MN(0, A^-1, O),   A = diag(precisions)

Samples have weights h. All outputs share one subset of the basis functions and one precision for
each function; the prior of the weights has the covariance of the noise across outputs. This choice
makes everything closed-form: with L = A + Phi' H Phi, the posterior of W is MN(M, L^-1, O),
M = L^-1 Phi' H X, and the evidence, the integral over W of the weighted likelihood, is

    log p(X) = -D T/2 log 2 pi - T/2 log|O| + D/2 (log|A| - log|L|) - 1/2 tr O^-1 (X'HX - M'LM)

where T = sum h. For given precisions the best O is (X'HX - M'LM + prior) / (T + nu). For given O
the best precision of one function has the closed form of Tipping and Faul (AISTATS 2003), here with
all D outputs together. Functions are added, removed and re-estimated one at a time, always with the
largest gain. Only the sums Phi'H Phi, Phi'HX and X'HX are needed, so a step costs O(K m + K D) for
K candidates and m active functions, independent of the number of samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.inference.arrays import Array, Index

# Unexplained share of a candidate, given the active functions, below which it is not added.
MIN_UNEXPLAINED_SHARE = 1e-8
# Relative squared difference below which two functions count as equal.
ALIGNED_TOLERANCE = 1e-8
# Maximum prior standard deviation of a weight, in standard deviations of the outputs. It bounds the
# weights of kernels that are nearly zero at all samples of the expert.
MAX_WEIGHT_SIGMA = 10.0
MAX_ROUNDS = 100  # maximum number of rounds; each takes greedy steps and re-estimates the noise


@dataclass(frozen=True, eq=False)
class WeightedSums:
    """Sums over samples that determine the evidence.

    Attributes:
        gram: (K, K) Phi' H Phi of all candidates.
        cross: (K, D) Phi' H X.
        outer: (D, D) X' H X.
        total: sum of weights T.
    """

    gram: Array
    cross: Array
    outer: Array
    total: float

    @classmethod
    def of(cls, features: Array, targets: Array, weights: Array) -> WeightedSums:
        """Sums over features (N, K), targets (N, D), weights (N,)."""
        # Skip samples without weight, which belong to other experts.
        some = weights > 1e-10 * weights.max()
        if not some.all():
            features, targets, weights = features[some], targets[some], weights[some]
        root = np.sqrt(weights)[:, None]
        phi, x = root * features, root * targets
        return cls(phi.T @ phi, phi.T @ x, x.T @ x, float(weights.sum()))


@dataclass(frozen=True, eq=False)
class RegressionPrior:
    """Inverse Wishart penalty -nu/2 log|O| - 1/2 tr(O^-1 scale) of the noise.

    Attributes:
        strength: Strength nu >= 0, in samples.
        scale: (D, D) nu times the covariance preferred by the prior.
    """

    strength: float
    scale: Array


@dataclass(frozen=True, eq=False)
class SparseRegression:
    """The posterior of the weights of the active basis functions.

    Attributes:
        active: (m,) indices of basis functions.
        precisions: (m,) diagonal of A.
        weights: (m, D) posterior mean M.
        covariance: (m, m) L^-1; the covariance of the weights is its Kronecker product with O.
        noise: (D, D) covariance O of the noise.
        evidence: log evidence plus the penalty of the noise, nats.
    """

    active: Index
    precisions: Array
    weights: Array
    covariance: Array
    noise: Array
    evidence: float

    def mean(self, features: Array) -> Array:
        """Means M' phi, (n, D), from the features (n, K) of all candidates."""
        return features[:, self.active] @ self.weights

    def spread(self, features: Array) -> Array:
        """phi' L^-1 phi, (n,): the variance of the mean in units of the noise."""
        phi = features[:, self.active]
        return np.asarray(np.maximum(((phi @ self.covariance) * phi).sum(1), 0.0))


def posterior(
    sums: WeightedSums, active: Index, precisions: Array, noise: Array, prior: RegressionPrior
) -> SparseRegression:
    """The posterior for given functions, precisions and noise, by a Cholesky decomposition."""
    inner = sums.gram[np.ix_(active, active)] + np.diag(precisions)
    # Scale to a unit diagonal, because precisions span many orders of magnitude.
    root = 1.0 / np.sqrt(np.diagonal(inner))
    factor = np.linalg.cholesky(inner * root[:, None] * root)
    whitener = np.linalg.inv(factor) * root
    covariance = whitener.T @ whitener
    half = whitener @ sums.cross[active]
    weights = whitener.T @ half
    log_det_inner = 2.0 * float(np.log(np.diagonal(factor)).sum() - np.log(root).sum())
    residual = sums.outer - half.T @ half
    noise_factor = np.linalg.cholesky(noise)
    log_det_noise = 2.0 * float(np.log(np.diagonal(noise_factor)).sum())
    noise_whitener, outputs = np.linalg.inv(noise_factor), len(noise)
    z = noise_whitener @ (residual + prior.scale) @ noise_whitener.T
    evidence = -0.5 * (
        outputs * sums.total * np.log(2.0 * np.pi)
        + (sums.total + prior.strength) * log_det_noise
        + outputs * (log_det_inner - float(np.log(precisions).sum()))
        + float(np.trace(z))
    )
    return SparseRegression(active, precisions, weights, covariance, noise, evidence)


def with_best_noise(
    sums: WeightedSums, found: SparseRegression, prior: RegressionPrior
) -> SparseRegression:
    """Re-estimate the noise of a regression and keep its functions and precisions."""
    cross = sums.cross[found.active]
    residual = sums.outer - cross.T @ found.weights
    noise = (residual + prior.scale) / (sums.total + prior.strength)
    noise = 0.5 * (noise + noise.T)
    return posterior(sums, found.active, found.precisions, noise, prior)


def maximise_evidence(
    sums: WeightedSums,
    prior: RegressionPrior,
    start: SparseRegression | None = None,
    *,
    steps: int = 10,
    rounds: int = MAX_ROUNDS,
    tolerance: float = 1e-3,
) -> SparseRegression:
    """Maximise the evidence, starting from an earlier result or from no functions.

    Args:
        start: Earlier result to start from; the sample weights may have changed since.
        steps: Number of greedy steps between two estimates of the noise.
        rounds: Maximum number of estimates of the noise.
        tolerance: Gain of a round, nats, below which the rounds end.
    """
    if start is None:
        none: Index = np.zeros(0, dtype=np.intp)
        noise = (sums.outer + prior.scale) / (sums.total + prior.strength)
        found = posterior(sums, none, np.zeros(0), noise, prior)
    else:
        found = posterior(sums, start.active, start.precisions, start.noise, prior)
        found = with_best_noise(sums, found, prior)
    for _ in range(rounds):
        before = found.evidence
        found, moved = _greedy(sums, found, prior, steps, 0.1 * tolerance)
        found = with_best_noise(sums, found, prior)
        if not moved or found.evidence - before < tolerance:
            break
    return found


def _greedy(
    sums: WeightedSums,
    found: SparseRegression,
    prior: RegressionPrior,
    steps: int,
    tolerance: float,
) -> tuple[SparseRegression, bool]:
    """Add, remove and re-estimate functions for a fixed noise, one best change at a time."""
    state = _GreedyState(sums, found)
    moved = False
    for _ in range(steps):
        if not state.step(tolerance):
            break
        moved = True
    if not moved:
        return found, False
    better = posterior(sums, state.active, state.precisions, found.noise, prior)
    # Rank-one updates accumulate rounding errors, so check that the evidence has increased.
    if not better.evidence > found.evidence:
        return found, False
    return better, True


class _GreedyState:
    """The quantities of Tipping and Faul for all candidates, updated by rank one.

    S_k = phi_k' C^-1 phi_k and Q_k = phi_k' C^-1 X in whitened outputs, C = H^-1 + Phi A^-1 Phi'.
    """

    def __init__(self, sums: WeightedSums, found: SparseRegression) -> None:
        self.gram = sums.gram
        self.outputs = len(found.noise)
        factor = np.linalg.cholesky(found.noise)
        whitened = np.linalg.solve(factor, sums.cross.T).T
        self.active = found.active
        self.precisions = found.precisions
        self.covariance = found.covariance
        columns = self.gram[:, self.active]
        half = columns @ self.covariance
        self.S = np.diagonal(self.gram) - (half * columns).sum(1)
        self.Q = whitened - half @ whitened[self.active]
        total = float(np.trace(np.linalg.solve(found.noise, sums.outer)))
        variance = max(total / (self.outputs * sums.total), 1e-300)
        self.least_precision = 1.0 / (MAX_WEIGHT_SIGMA**2 * variance)
        self.least = MIN_UNEXPLAINED_SHARE * np.maximum(np.diagonal(self.gram), 1e-300)
        self.is_active = np.zeros(len(self.gram), dtype=bool)
        self.is_active[self.active] = True
        self._exclude()

    def step(self, tolerance: float) -> bool:
        """Make the best change; return False if no change gains more than the tolerance, nats."""
        with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
            k, gain, precision = self._best()
        if not gain > tolerance:
            return False
        if not self.is_active[k]:
            self._add(k, precision)
        else:
            place = int(np.flatnonzero(self.active == k)[0])
            if np.isinf(precision):
                self._remove(place)
            else:
                self._change(place, precision)
        return True

    def _best(self) -> tuple[int, float, float]:
        """The function with the largest gain of evidence, the gain, and its new precision.

        A function of precision a adds 1/2 (d log(a / (a + s)) + q / (a + s)) to the evidence.
        """
        d = self.outputs
        s, q = self.S.copy(), np.einsum('kd,kd->k', self.Q, self.Q)
        # Active functions are treated as if they were not in the model.
        a, own = self.precisions, self.active
        variances = np.diagonal(self.covariance)
        s[own], q[own] = 1.0 / variances - a, q[own] / (a * variances) ** 2
        worth = q > d * s
        worth[own] &= s[own] > MIN_UNEXPLAINED_SHARE * a
        s[own] = np.maximum(s[own], 0.0)
        best = d * s**2 / np.where(worth, q - d * s, 1.0)
        best = np.where(worth, np.maximum(best, self.least_precision), np.inf)
        gain = 0.5 * (d * np.log1p(-s / (best + s)) + q / (best + s))
        gain[self.excluded | (~self.is_active & (self.least >= self.S))] = -np.inf
        gain[own] -= 0.5 * (d * np.log(a / (a + s[own])) + q[own] / (a + s[own]))
        gain[np.isnan(gain)] = -np.inf
        # An unchanged precision gains nothing, and its update would divide by zero.
        gain[own] = np.where(np.abs(best[own] - a) <= 1e-9 * a, -np.inf, gain[own])
        k = int(np.argmax(gain))
        return k, float(gain[k]), float(best[k])

    def _exclude(self) -> None:
        """Exclude candidates that equal an active function, because they would add nothing."""
        squares = np.diagonal(self.gram)
        aligned = self.gram[:, self.active] ** 2 >= (1.0 - ALIGNED_TOLERANCE) * np.outer(
            squares, squares[self.active]
        )
        self.excluded = aligned.any(1) & ~self.is_active

    def _add(self, k: int, precision: float) -> None:
        variance = 1.0 / (precision + self.S[k])
        column = self.gram[self.active, k]
        pull = self.covariance @ column
        left = self.gram[:, k] - self.gram[:, self.active] @ pull
        m = len(self.active)
        grown = np.empty((m + 1, m + 1))
        grown[:m, :m] = self.covariance + variance * np.outer(pull, pull)
        grown[m, :m] = grown[:m, m] = -variance * pull
        grown[m, m] = variance
        self.covariance = grown
        self.S = self.S - variance * left**2
        self.Q = self.Q - np.outer(variance * left, self.Q[k])
        self.active = np.append(self.active, k)
        self.precisions = np.append(self.precisions, precision)
        self.is_active[k] = True
        squares = np.diagonal(self.gram)
        self.excluded |= self.gram[:, k] ** 2 >= (1.0 - ALIGNED_TOLERANCE) * squares * squares[k]
        self.excluded[k] = False

    def _change(self, place: int, precision: float) -> None:
        column = self.covariance[:, place].copy()
        old = self.precisions[place]
        kappa = 1.0 / (column[place] + 1.0 / (precision - old))
        self._take(place, column, kappa)
        self.precisions = self.precisions.copy()
        self.precisions[place] = precision

    def _remove(self, place: int) -> None:
        column = self.covariance[:, place].copy()
        self._take(place, column, 1.0 / column[place])
        self.is_active[self.active[place]] = False
        self.covariance = np.delete(np.delete(self.covariance, place, 0), place, 1)
        self.active = np.delete(self.active, place)
        self.precisions = np.delete(self.precisions, place)
        self._exclude()

    def _take(self, place: int, column: Array, kappa: float) -> None:
        """Subtract kappa column column' from the covariance; update S and Q."""
        left = self.gram[:, self.active] @ column
        # Q of an active function is its precision times its weight.
        weight = self.Q[self.active[place]] / self.precisions[place]
        self.covariance = self.covariance - kappa * np.outer(column, column)
        self.S = self.S + kappa * left**2
        self.Q = self.Q + np.outer(kappa * left, weight)
