"""Variational mixture smoothing: from mixtures over poses to one over trajectories (VMS fig. 1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.block_tridiagonal import BlockCholesky
from hmt_ros.inference.energy import Derivatives
from hmt_ros.inference.linear_gaussian_dynamics import LinearGaussianDynamics, TrajectoryPrior
from hmt_ros.smoothing.embedded_network import Paths
from hmt_ros.smoothing.likelihood import LikelihoodPart, SequenceLikelihood, check_mixtures
from hmt_ros.smoothing.mode_sequence import ModeSequence, TrajectoryGaussians, path_gaussians
from hmt_ros.smoothing.trajectory_mixture import TrajectoryMixture
from hmt_ros.smoothing.trajectory_refinement import limits_of_states, refine
from hmt_ros.smoothing.variational_mixture import (
    ADAPTED_PARAMETERS,
    VariationalMixture,
    laplace_masses,
    minimise_free_energy,
)

# Maximum number of noise values in the descent of the free energy, which limits the samples.
SAMPLE_BUDGET = 400_000
# Minimum weight of a component in the descent, relative to the heaviest component.
MIN_RELATIVE_WEIGHT = 1e-6
# Minimum length of a sequence in which parts that differ from the best path are refined first, and
# margin on either side of such a part, images.
LONG_WINDOW = 100
PART_MARGIN = 8
# Distance from an optimum below which a path's Gaussian is redundant, standard deviations.
SAME_DISTANCE = 0.3
# Mode distances below which modes are merged, to get alternatives to the optima, standard
# deviations.
MERGE_DISTANCES = (1.75, 2.5)


@dataclass(frozen=True, eq=False)
class MixtureSmoother:
    """Smooths mixtures with independent errors; for persistent errors see `likelihood.counted`.

    Attributes:
        dynamics: dynamics of the state.
        lower, upper: (d,) limits of the pose at every time; None: no limits.
        max_trajectories: maximum number of components of the result.
        adapt: variables adapted by the descent of the free energy, a subset of
            `ADAPTED_PARAMETERS`; empty: no descent.
        max_iterations: maximum number of iterations of the descent of the free energy.

    Raises:
        ValueError: a setting is out of range.
    """

    dynamics: LinearGaussianDynamics
    lower: ArrayLike | None = None
    upper: ArrayLike | None = None
    max_trajectories: int = 64
    adapt: Sequence[str] = ADAPTED_PARAMETERS
    max_iterations: int = 15

    def __post_init__(self) -> None:
        if self.max_trajectories < 1:
            raise ValueError(f'max_trajectories must be at least 1, saw {self.max_trajectories}')
        wrong = [name for name in self.adapt if name not in ADAPTED_PARAMETERS]
        if wrong:
            raise ValueError(f'adapt: no {wrong[0]!r}, wanted some of {ADAPTED_PARAMETERS}')
        self._limits()

    def smooth(
        self,
        mixtures: Sequence[GaussianMixture],
        seed: int = 0,
        *,
        stamps_ns: Sequence[int] | None = None,
        observation: SequenceLikelihood | None = None,
    ) -> TrajectoryMixture:
        """Compute a mixture over trajectories from likelihood mixtures, one for each time.

        Args:
            mixtures: T likelihoods over the pose, whose weights need not sum to 1.
            stamps_ns: (T,) times, increasing; None: one `dynamics.step` apart.
            observation: likelihood for refinement and free energy, for example from the images
                themselves; the mixtures then give only the initial paths. None: the mixtures are
                the likelihood.

        Raises:
            ValueError: mixtures or stamps can not be smoothed; the message says why.
        """
        check_mixtures(mixtures)
        if mixtures[0].dimension != self.dynamics.dimension:
            raise ValueError(
                f'mixtures have {mixtures[0].dimension} variables, the dynamics '
                f'{self.dynamics.dimension}'
            )
        intervals = intervals_of(stamps_ns, len(mixtures), self.dynamics.step)
        kept = tuple(mixture[mixture.weights > 0] for mixture in mixtures)
        sequence = ModeSequence(kept, self.dynamics, intervals)
        if observation is not None and observation.times != len(mixtures):
            raise ValueError(f'{observation.times} observations for {len(mixtures)} mixtures')
        return self.smooth_sequence(sequence, seed, stamps_ns, observation)

    def smooth_sequence(
        self,
        sequence: ModeSequence,
        seed: int = 0,
        stamps_ns: Sequence[int] | None = None,
        observation: SequenceLikelihood | None = None,
    ) -> TrajectoryMixture:
        """Smooth inputs that are already checked; see `smooth`."""
        likelihood = sequence.likelihood if observation is None else observation
        best, least = self.optima(sequence, likelihood), np.nan
        for other in self.merged_paths(sequence) if observation is None else ():
            if np.isnan(least):
                least = self._free_energy(best, sequence.prior, likelihood, seed)
            energy = self._free_energy(other, sequence.prior, likelihood, seed)
            if energy < least:
                best, least = other, energy
        return self._fitted(best, sequence.prior, likelihood, seed, stamps_ns)

    def paths(self, sequence: ModeSequence) -> Paths:
        """Return the paths from which trajectories start."""
        return sequence.paths(self.max_trajectories)

    def optima(self, sequence: ModeSequence, likelihood: SequenceLikelihood) -> TrajectoryGaussians:
        """Return distinct optima from the paths and, if there are few, Gaussians of other paths."""
        low, high = self._limits()
        prior, paths = sequence.prior, self.paths(sequence)
        d = prior.dimension
        starts = sequence.states(paths)
        # Refine parts that other paths share with the best path only once.
        best = refine(starts[:1], prior, likelihood, low[:d], high[:d])
        shared = paths.nodes == paths.nodes[0]
        starts = np.where(shared[:, :, None], best.states, starts)
        if starts.shape[1] >= LONG_WINDOW:
            starts = with_refined_parts(starts, shared, prior, likelihood, low[:d], high[:d])
        refined = refine(starts, prior, likelihood, low[:d], high[:d])
        refined = refined.without_duplicates()
        masses = laplace_masses(refined.energies, refined.factors)
        result = TrajectoryGaussians(refined.states, refined.factors, masses)
        room = self.max_trajectories - len(refined)
        if room == 0 or len(refined) == len(paths) or likelihood is not sequence.likelihood:
            return result
        # Overlapping modes share an optimum, but one Gaussian at this optimum is a poor
        # approximation.
        beside = path_gaussians(paths.nodes, prior, sequence.likelihood)
        distinct = [
            i
            for i in range(len(paths))
            if all(
                np.square(factor.whiten(beside.states[i] - state)).sum() > SAME_DISTANCE**2
                for factor, state in zip(refined.factors, refined.states)
            )
        ][:room]
        return TrajectoryGaussians(
            np.concatenate([refined.states, np.clip(beside.states[distinct], low, high)]),
            refined.factors + tuple(beside.factors[i] for i in distinct),
            np.concatenate([masses, beside.log_weights[distinct]]),
        )

    def merged_paths(self, sequence: ModeSequence) -> Iterator[TrajectoryGaussians]:
        """Yield Gaussians of paths through merged modes, for each of the `MERGE_DISTANCES`."""
        count = sum(len(mixture) for mixture in sequence.mixtures)
        for distance in MERGE_DISTANCES:
            merged = sequence.merged(distance)
            left = sum(len(mixture) for mixture in merged.mixtures)
            if left < count:
                nodes = self.paths(merged).nodes
                found = path_gaussians(nodes, merged.prior, merged.likelihood)
                yield replace(found, states=np.clip(found.states, *self._limits()))
                count = left

    def _free_energy(
        self,
        candidates: TrajectoryGaussians,
        prior: TrajectoryPrior,
        likelihood: SequenceLikelihood,
        seed: int,
    ) -> float:
        return self._descended(candidates, prior, likelihood, seed, 0).fresh[0]

    def _descended(
        self,
        candidates: TrajectoryGaussians,
        prior: TrajectoryPrior,
        likelihood: SequenceLikelihood,
        seed: int,
        max_iterations: int,
    ) -> VariationalMixture:
        """Optimise heavy components, and leave light components unchanged."""
        low, high = self._limits()
        weights, means = candidates.weights, candidates.states.copy()
        heavy = weights > MIN_RELATIVE_WEIGHT * weights.max()
        states = means[heavy]
        samples = int(np.clip(SAMPLE_BUDGET // states.size // 2 * 2, 4, 32))
        found = minimise_free_energy(
            weights[heavy],
            states,
            tuple(candidates.factors[i] for i in np.flatnonzero(heavy)),
            prior,
            likelihood,
            adapt=self.adapt,
            low=low,
            high=high,
            samples=samples,
            seed=seed,
            max_iterations=max_iterations,
        )
        if heavy.all():
            return found
        inflation = np.ones(len(weights))
        weights[heavy] = weights[heavy].sum() * found.weights
        means[heavy], inflation[heavy] = found.states, found.inflation
        return replace(found, weights=weights, states=means, inflation=inflation)

    def _fitted(
        self,
        candidates: TrajectoryGaussians,
        prior: TrajectoryPrior,
        likelihood: SequenceLikelihood,
        seed: int,
        stamps_ns: Sequence[int] | None,
    ) -> TrajectoryMixture:
        """Fit the mixture that is closest to the posterior, starting from the candidates."""
        iterations = self.max_iterations if self.adapt else 0
        found = self._descended(candidates, prior, likelihood, seed, iterations)
        result = trajectory_mixture(
            found.weights,
            found.states,
            candidates.factors,
            found.inflation,
            prior,
            likelihood,
            stamps_ns,
            *self._limits(),
        )
        return replace(result, free_energy=found.free_energy, free_energy_fresh=found.fresh)

    def _limits(self) -> tuple[Array, Array]:
        return limits_of_states(
            -np.inf if self.lower is None else self.lower,
            np.inf if self.upper is None else self.upper,
            self.dynamics.dimension,
            self.dynamics.state_dimension,
        )


def trajectory_mixture(
    weights: Array,
    states: Array,
    factors: Sequence[BlockCholesky],
    inflation: Array,
    prior: TrajectoryPrior,
    likelihood: SequenceLikelihood,
    stamps_ns: Sequence[int] | None,
    low: Array,
    high: Array,
) -> TrajectoryMixture:
    """Build the mixture, heaviest component first, with log joint densities.

    Args:
        weights, states, factors, inflation, stamps_ns: as for `TrajectoryMixture`.
        prior, likelihood: prior of the states and likelihood of the poses.
        low, high: (n,) limits of the states.
    """
    order = np.argsort(-weights, kind='stable')
    states = states[order]
    count, times, _ = states.shape
    energies, _ = prior.energy(states)
    at = np.tile(np.arange(times), count)
    d = prior.dimension
    seen = likelihood.energy(states[:, :, :d].reshape(-1, d), at, derivatives=Derivatives.NONE)
    return TrajectoryMixture(
        weights=weights[order],
        states=states,
        factors=tuple(factors[i] for i in order),
        inflation=inflation[order],
        log_joint=-(energies + seen.value.reshape(count, times).sum(1)),
        free_energy=np.empty(0),
        dimension=d,
        stamps_ns=None if stamps_ns is None else tuple(int(stamp) for stamp in stamps_ns),
        lower=low[:d],
        upper=high[:d],
    )


def with_refined_parts(
    starts: Array,
    shared: NDArray[np.bool_],
    prior: TrajectoryPrior,
    likelihood: SequenceLikelihood,
    lower: Array,
    upper: Array,
) -> Array:
    """Optimise those parts of initial trajectories (M, T, n) that differ from the first trajectory.

    In a long sequence most paths differ only near its ends, and many have the same ends. The
    differing parts are therefore few and short, while a step of a whole trajectory evaluates all
    images.

    Args:
        starts: (M, T, n) initial trajectories, of which the first is an optimum.
        shared: (M, T) whether each state equals the first trajectory's state at that time.
    """
    times = starts.shape[1]
    parts: dict[tuple[int, int], list[int]] = {}
    for i, same in enumerate(shared):
        apart = np.lib.stride_tricks.sliding_window_view(
            np.pad(~same, PART_MARGIN), 2 * PART_MARGIN + 1
        ).any(1)
        edges = np.flatnonzero(np.diff(apart, prepend=False, append=False))
        for first, last in zip(edges[::2], edges[1::2]):
            if last - first <= times // 2:
                parts.setdefault((int(first), int(last)), []).append(i)
    result = starts.copy()
    for (first, last), owners in parts.items():
        some, owner = np.unique(starts[owners, first:last], axis=0, return_inverse=True)
        found = refine(
            some,
            prior.between(first, last, starts[0]),
            LikelihoodPart(likelihood, first, last - first),
            lower,
            upper,
        )
        result[owners, first:last] = found.states[owner.reshape(-1)]
    return result


def intervals_of(stamps_ns: Sequence[int] | None, times: int, step: float) -> Array:
    """Return the intervals (T-1,) between successive times, s.

    Raises:
        ValueError: the number of stamps is wrong, or the stamps do not increase.
    """
    if stamps_ns is None:
        return np.full(times - 1, step)
    if len(stamps_ns) != times:
        raise ValueError(f'{len(stamps_ns)} stamps for {times} mixtures')
    stamps = [int(stamp) for stamp in stamps_ns]
    for before, after in pairwise(stamps):
        if after <= before:
            raise ValueError(f'stamps must increase, saw {after} ns after {before} ns')
    return np.array([after - before for before, after in pairwise(stamps)]) * 1e-9
