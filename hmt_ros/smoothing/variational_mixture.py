"""The mixture over trajectories that is closest to the posterior (VMS 6, with the numbers there).

    q(X) = sum_i a_i N(X; M_i, s_i^2 S_i)

    F(q) = KL(q || p(X | R)) - log p(R) = E_q[log q(X) - log p(X, R)]             (2), (4)

         = sum_i a_i E_i[log q(X) - log p(X, R)]                                  (7)

F is minimised over proportions a (softmax), means M and inflations s (log); S_i^-1 = L_i L_i'. The
expectation is over samples

    X = M_i + s_i L_i'^-1 z

with the same antithetic noise z throughout. The sampled F is therefore smooth, its gradients are
exact, and its descent is repeatable. The reported F uses fresh samples and has a standard error.
Variables are scaled by the curvature of F for a posterior equal to q: means by L_i sqrt(a_i), log
s_i by sqrt(2 D a_i).

Most pairs of components are far apart and are skipped. The expected responsibility of j for samples
of i is at most

    E_i[a_j q_j / (a_i q_i + a_j q_j)] <= (a_j / a_i)^(1/2) / 2 int (q_i q_j)^(1/2)

The overlap of two trajectories is at most the overlap of their poses at any one time, which for
Gaussians is at most exp(-1/4 D'(C_i + C_j)^-1 D). Pairs below exp(-30) are skipped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import add_band_product, add_component_overlaps, elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.block_tridiagonal import BlockCholesky
from hmt_ros.inference.energy import Derivatives
from hmt_ros.inference.gaussian_pairs import pair_distances
from hmt_ros.inference.lbfgs import descent
from hmt_ros.inference.linear_algebra import log_sum_exp, product
from hmt_ros.inference.linear_gaussian_dynamics import TrajectoryPrior
from hmt_ros.inference.random_numbers import standard_normals
from hmt_ros.inference.threads import together
from hmt_ros.smoothing.likelihood import SequenceLikelihood

ADAPTED_PARAMETERS = ('weights', 'means', 'inflation')
# Number of parts into which components are split; it is fixed so that sums keep their order.
PART_COUNT = 4
# Maximum number of successive iterations without a gain on held-out samples.
MAX_IDLE_ITERATIONS = 3
HISTORY_LENGTH = 8  # number of stored steps in L-BFGS
# Lower bound on the proportion in the scale of a component's variables.
MIN_WEIGHT = 1e-4
# Minus the logarithm of a negligible overlap.
NEGLIGIBLE_OVERLAP = 30.0


@dataclass(frozen=True, eq=False)
class VariationalMixture:
    """A mixture over trajectories of states, with the trace of its optimisation.

    Attributes:
        weights: (M,) proportions a_i.
        states: (M, T, n) means M_i.
        inflation: (M,) factors s_i on standard deviations.
        free_energy: (I,) F at the start and after each iteration, on the samples of the descent,
            nats.
        held_out: (J,) F at each iteration on the held-out samples that select the best iterate,
            nats; J >= I, because the descent continues for some iterations after the best. Empty
            without a descent.
        fresh: F on unused samples, and its standard error, nats.
    """

    weights: Array
    states: Array
    inflation: Array
    free_energy: Array
    held_out: Array
    fresh: tuple[float, float]


def laplace_masses(energies: Array, factors: Sequence[BlockCholesky]) -> Array:
    """Return the log integrals (M,) of p(X, R) around optima, by Laplace's approximation."""
    size = factors[0].times * factors[0].size
    determinants = np.array([factor.log_determinant for factor in factors])
    return np.asarray(-energies - 0.5 * determinants + 0.5 * size * elementary.log(2 * np.pi))


def minimise_free_energy(
    weights: Array,
    states: Array,
    factors: Sequence[BlockCholesky],
    prior: TrajectoryPrior,
    likelihood: SequenceLikelihood,
    *,
    adapt: Sequence[str] = ADAPTED_PARAMETERS,
    low: Array | float = -np.inf,
    high: Array | float = np.inf,
    samples: int = 8,
    seed: int = 0,
    max_iterations: int = 15,
    tolerance: float = 1e-4,
) -> VariationalMixture:
    """Minimise F from a mixture of M components with inflation 1.

    Args:
        weights: (M,) proportions.
        states: (M, T, n) means.
        adapt: names of the adapted variables, a subset of `ADAPTED_PARAMETERS`.
        low, high: (n,) limits of the means.
        samples: number of samples per component, even.
        max_iterations: maximum number of L-BFGS iterations; 0 evaluates only.
        tolerance: gain of an iteration below which the descent ends, nats.

    Raises:
        ValueError: the number of samples is odd or below 2.
    """
    if samples < 2 or samples % 2:
        raise ValueError(f'samples must be an even number from 2 up, saw {samples}')
    size = states.shape[1] * states.shape[2]
    rng = np.random.default_rng(seed)
    descent, choice = (matched(antithetic(rng, len(weights), samples, size)) for _ in range(2))
    fresh = antithetic(rng, len(weights), samples, size)
    objective = FreeEnergy(weights, states, factors, prior, likelihood, adapt, low, high, descent)
    x = np.zeros(objective.parameters)
    if max_iterations > 0 and len(x):
        x, trace, held_out = _descend(objective, choice, max_iterations, tolerance)
    else:
        trace = np.array([_free_energy(objective, x, descent)])
        held_out = np.empty(0)
    mixture = objective.mixture(x)
    a, means, inflation = mixture
    each = objective.sampled(mixture, fresh)
    # Each antithetic pair counts as one observation.
    pairs = each.reshape(len(a), -1, 2).mean(2)
    error = np.nan
    if pairs.shape[1] > 1:
        error = float(np.sqrt((a**2 * pairs.var(1, ddof=1) / pairs.shape[1]).sum()))
    return VariationalMixture(
        a,
        means.reshape(states.shape),
        inflation,
        trace,
        held_out,
        (float(product(a, each.mean(1))), error),
    )


def antithetic(rng: np.random.Generator, components: int, samples: int, size: int) -> Array:
    """Draw white noise (M, S, D) in pairs z, -z."""
    half = standard_normals(rng, (components, samples // 2, 1, size))
    return np.concatenate([half, -half], axis=2).reshape(components, samples, size)


def matched(noise: Array) -> Array:
    """Scale noise (M, S, D) so that its variance is 1 in each component.

    With few samples the inflation would otherwise adapt to the random variance of the noise.
    """
    return np.asarray(noise / np.sqrt((noise * noise).mean((1, 2), keepdims=True)))


def _descend(
    objective: FreeEnergy, choice: Array, max_iterations: int, tolerance: float
) -> tuple[Array, Array, Array]:
    """Run L-BFGS from 0; return the best iterate, F until then, and F on held-out samples.

    With few samples the descent would overfit. The iterate with the least F on held-out samples is
    kept, and the descent ends when F on these samples no longer falls.
    """
    best = start = np.zeros(objective.parameters)
    first = objective(start)
    trace, held_out = [first[0]], [_free_energy(objective, start, choice)]
    # The start has already been evaluated.
    iterates = descent(
        lambda x: objective(x) if x.any() else first,
        start,
        memory=HISTORY_LENGTH,
        most_evaluations=3 * max_iterations,
    )
    for x, value in islice(iterates, max_iterations):
        if value > trace[-1]:
            break
        gained = trace[-1] - value
        trace.append(value)
        held_out.append(_free_energy(objective, x, choice))
        if held_out[-1] < min(held_out[:-1]):
            best = x
        if (
            gained < tolerance
            or len(held_out) - 1 - int(np.argmin(held_out)) >= MAX_IDLE_ITERATIONS
        ):
            break
    return best, np.array(trace[: int(np.argmin(held_out)) + 1]), np.array(held_out)


def _free_energy(objective: FreeEnergy, x: Array, noise: Array) -> float:
    mixture = objective.mixture(x)
    return float(product(mixture[0], objective.sampled(mixture, noise).mean(1)))


# Proportions (M,), means (M, D) and inflations (M,).
Mixture = tuple[Array, Array, Array]


class FreeEnergy:
    """F on fixed samples as a function of unconstrained variables, which are 0 at the start."""

    def __init__(
        self,
        weights: Array,
        states: Array,
        factors: Sequence[BlockCholesky],
        prior: TrajectoryPrior,
        likelihood: SequenceLikelihood,
        adapt: Sequence[str],
        low: Array | float,
        high: Array | float,
        noise: Array,
    ) -> None:
        self.count, self.times, self.size = states.shape
        self.total = self.times * self.size
        self.prior, self.likelihood, self.noise = prior, likelihood, noise
        self.band = prior.precision.band()
        self.start = np.ascontiguousarray(states.reshape(self.count, -1))
        self.log_weights = elementary.log(np.maximum(weights, 1e-300))
        self.factors = list(factors)
        self.low = np.tile(np.broadcast_to(low, (self.size,)), self.times)
        self.high = np.tile(np.broadcast_to(high, (self.size,)), self.times)
        self.scale = np.sqrt(np.maximum(weights, MIN_WEIGHT))
        self.spread = self.scale * np.sqrt(2.0 * self.total)
        sizes = {
            'weights': self.count,
            'means': self.count * self.total,
            'inflation': self.count,
        }
        self.slices: dict[str, slice] = {}
        at = 0
        for name, size in sizes.items():
            if name in adapt:
                self.slices[name] = slice(at, at + size)
                at += size
        self.parameters = at
        self.bands = np.stack([factor.columns for factor in factors])
        self.marginals = np.stack([factor.inverse_blocks() for factor in factors])
        self.log_determinants = np.array([factor.log_determinant for factor in factors])
        self.roots = self._coloured(noise)

    def _coloured(self, noise: Array) -> Array:
        """Products L_i'^-1 z, (M, ..., D), for vectors z (M, ..., D)."""
        return np.stack([factor.solve_transposed(z) for factor, z in zip(self.factors, noise)])

    def mixture(self, x: Array) -> Mixture:
        """The mixture for values x of the unconstrained variables."""
        log = self.log_weights
        if 'weights' in self.slices:
            log = log + x[self.slices['weights']] / self.scale
        means = self.start
        if 'means' in self.slices:
            moves = x[self.slices['means']].reshape(self.count, -1) / self.scale[:, None]
            means = np.clip(means + self._coloured(moves), self.low, self.high)
        inflation = np.ones(self.count)
        if 'inflation' in self.slices:
            inflation = elementary.exp(
                np.clip(x[self.slices['inflation']] / self.spread, -3.0, 3.0)
            )
        return elementary.exp(log - log_sum_exp(log)), means, inflation

    def sampled(self, mixture: Mixture, noise: Array) -> Array:
        """Values (M, S) of log q(X) - log p(X, R) at samples from noise (M, S, D)."""
        return self._evaluate(mixture, noise, self._coloured(noise), derivatives=False)[0]

    def __call__(self, x: Array) -> tuple[float, Array]:
        """Compute F and its gradient."""
        mixture = self.mixture(x)
        weights, means, inflation = mixture
        each, slope, parts = self._evaluate(mixture, self.noise, self.roots)
        mean_gradient, inflation_gradient, weight_gradient = parts
        value = float(product(weights, each.mean(1)))
        gradient = np.empty(self.parameters)
        share = weights / each.shape[1]
        if 'weights' in self.slices:
            log = weights * each.mean(1) + weight_gradient
            gradient[self.slices['weights']] = (log - weights * log.sum()) / self.scale
        if 'means' in self.slices:
            down = mean_gradient + share[:, None] * slope.sum(1)
            down[(means <= self.low) | (means >= self.high)] = 0.0
            down = np.stack([f.solve_lower(g) for f, g in zip(self.factors, down)])
            gradient[self.slices['means']] = (down / self.scale[:, None]).reshape(-1)
        if 'inflation' in self.slices:
            along = np.einsum('msd,msd->m', slope, self.roots) * inflation
            gradient[self.slices['inflation']] = (inflation_gradient + share * along) / self.spread
        return value, gradient

    def _evaluate(
        self, mixture: Mixture, noise: Array, roots: Array, *, derivatives: bool = True
    ) -> tuple[Array, Array, tuple[Array, ...]]:
        """Values (M, S) of log q - log p, gradients, and gradients of log q at fixed samples."""
        weights, means, inflation = mixture
        count, samples, total = noise.shape
        log_scales = 0.5 * self.log_determinants - total * (
            elementary.log(inflation) + 0.5 * elementary.log(2 * np.pi)
        )
        log_weights = elementary.log(np.maximum(weights, 1e-300))
        near, farthest = self._near(means, inflation)
        each = np.empty((count, samples))
        slope = np.empty((count, samples, total))
        edges = np.linspace(0, count, PART_COUNT + 1).astype(int)
        sums = [
            (np.zeros((count, total)), np.zeros(count), np.zeros(count)) for _ in range(PART_COUNT)
        ]

        def work(part: int) -> None:
            for i in range(edges[part], edges[part + 1]):
                points = means[i] + inflation[i] * roots[i]
                add_component_overlaps(
                    i,
                    points,
                    noise[i],
                    log_weights,
                    log_scales,
                    means,
                    inflation,
                    self.bands,
                    near[i],
                    self.size * farthest[i],
                    derivatives,
                    weights[i] / samples,
                    each[i],
                    slope[i],
                    *sums[part],
                )
                energy, pull = self._energy(points)
                each[i] += energy
                if derivatives:
                    slope[i] += pull

        together([partial(work, part) for part in range(PART_COUNT)])
        return each, slope, tuple(sum(column[1:], start=column[0]) for column in zip(*sums))

    def _energy(self, points: Array) -> tuple[Array, Array]:
        """Energies -log p(X, R), (S,), and gradients (S, D) at trajectories (S, D)."""
        s, d = len(points), self.prior.dimension
        gradient = np.zeros_like(points)
        add_band_product(self.band, points, gradient)
        information = self.prior.information.reshape(-1)
        value = np.einsum('sd,sd->s', points, 0.5 * gradient - information) + self.prior.constant
        gradient -= information
        poses = points.reshape(s * self.times, self.size)[:, :d]
        at = np.tile(np.arange(self.times), s)
        found = self.likelihood.energy(poses, at, derivatives=Derivatives.GRADIENT)
        assert found.gradient is not None
        gradient.reshape(s * self.times, self.size)[:, :d] += found.gradient
        return value + found.value.reshape(s, self.times).sum(1), gradient

    def _near(self, means: Array, inflation: Array) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
        """Return (M, M) whether two components can overlap at the time at which they differ most.

        Also return the index of this time, (M, M).
        """
        near = np.ones((self.count, self.count), dtype=bool)
        metric = self.bands[:, :, 0] ** 2
        farthest = np.empty((self.count, self.count), dtype=np.int64)
        for k in range(self.count):
            square = (means - means[k]) ** 2 * metric
            farthest[k] = square.reshape(self.count, self.times, self.size).sum(2).argmax(1)
        i, j = np.triu_indices(self.count, 1)
        at = farthest[i, j]
        poses = means.reshape(-1, self.size)
        pairs = np.stack([i, j], axis=1) * self.times + at[:, None]
        scales = np.repeat(inflation**2, self.times)
        distances = pair_distances(
            poses, self.marginals.reshape(-1, self.size, self.size), scales, pairs
        )
        near[i, j] = near[j, i] = 0.25 * distances < NEGLIGIBLE_OVERLAP
        return near, farthest
