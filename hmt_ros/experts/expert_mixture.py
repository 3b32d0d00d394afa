"""A mixture of sparse Bayesian experts as a model: starts, predictions, files (BME 2.2).

    p(x | r) = sum_i g_i(r) N(x; M_i' phi(r), O_i (1 + phi' S_i phi))

Learned by `expectation_maximisation`. What differs between the conditional and the joint model are
the gates.

Several starts, with the candidate kernel widths in turn, run for a few iterations on some of the
samples; the one with the highest bound goes on with all of them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from hmt_ros.experts.basis import (
    BASES,
    Basis,
    LinearBasis,
    RadialBasis,
    basis_of,
    clusters,
    spread_centres,
    squared_distances,
    typical_distance,
)
from hmt_ros.experts.conditional_density import Components, ConditionalDensity
from hmt_ros.experts.expectation_maximisation import (
    EMData,
    EMState,
    Gates,
    climb,
    e_step,
    m_step,
)
from hmt_ros.experts.gates import log_softmax
from hmt_ros.experts.model_file import Arrays, nested, part
from hmt_ros.experts.sparse_bayes import (
    RegressionPrior,
    SparseRegression,
    WeightedSums,
    maximise_evidence,
    maximum_likelihood,
)
from hmt_ros.experts.training_pairs import (
    Standardisation,
    TrainingPairs,
    checked_pairs,
    checked_scaling,
)

if TYPE_CHECKING:
    from typing_extensions import Self

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LEARNING = ('bayesian', 'maximum_likelihood')
# Kernel widths that are tried, in typical distances between inputs.
WIDTHS = (0.5, 1.0, 2.0)
# Iterations of a start in each round of the choice, and samples that it sees.
TRIAL_ITERATIONS = (2, 4, 8)
TRIAL_SAMPLES = 1000
# Part of the targets' variance that the prior of the noise pulls to.
NOISE_FLOOR = 1e-2


class ExpertMixture(ConditionalDensity):
    """What the conditional and the joint mixture of experts share.

    Args:
        n_experts: M at the start; empty ones are pruned.
        basis: of the experts, 'rbf' or 'linear'.
        width: of the kernels in standard deviations of the inputs; None tries several.
        max_kernels: candidates at most, spread over the training inputs.
        n_starts: of the iterations, per width.
        max_iterations: of EM.
        tolerance: ends when an iteration gains less, nats per sample.
        scaling: of inputs before distances are taken, 'each' column or one 'common' scale.
        learning: 'bayesian', or 'maximum_likelihood' without priors (linear experts only).
        seed: of the starts.

    Attributes:
        n_experts_: M that are left.
        basis_: candidates phi.
        experts_: M regressions, in units of standardised targets.
        gates_: which expert is responsible.
        bound_: F after each iteration since the last expert was pruned, nats, standardised targets.
        responsibilities_: (N, M) of the training samples.
        width_: of the kernels.
        inflation_: factor of all covariances, 1 unless `calibrate` has changed it.
    """

    n_experts_: int
    basis_: Basis
    experts_: tuple[SparseRegression, ...]
    gates_: Gates
    bound_: Array
    responsibilities_: Array
    inflation_: float

    def __init__(
        self,
        n_experts: int = 5,
        basis: str = 'rbf',
        seed: int = 0,
        *,
        width: float | None = None,
        max_kernels: int = 400,
        n_starts: int = 4,
        max_iterations: int = 100,
        tolerance: float = 1e-4,
        scaling: str = 'each',
        learning: str = 'bayesian',
    ) -> None:
        self.n_experts = n_experts
        self.basis = basis
        self.seed = seed
        self.width = width
        self.max_kernels = max_kernels
        self.n_starts = n_starts
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.scaling = scaling
        self.learning = learning

    @abstractmethod
    def _first_gates(self, basis: Basis, pairs: TrainingPairs, scaling: Standardisation) -> Gates:
        """Gates before they have learned anything."""

    @abstractmethod
    def _gates_of(self, arrays: Mapping[str, NDArray[Any]]) -> Gates:
        """Gates out of a file."""

    def fit(
        self,
        inputs: ArrayLike,
        targets: ArrayLike,
        sample_weight: ArrayLike | None = None,
        *,
        responsibilities: ArrayLike | None = None,
    ) -> Self:
        """Learns from inputs (N, p) and targets (N, D).

        Args:
            inputs: (N, p).
            targets: (N, D).
            sample_weight: (N,) not negative; 2 counts like the sample twice.
            responsibilities: (N, M) to start from, in place of starts of its own.

        Raises:
            ValueError: wrong shapes, values that are not finite, fewer samples than experts,
                parameters out of their range.
        """
        self._check_parameters()
        pairs = checked_pairs(
            inputs, targets, sample_weight, at_least=self.n_experts, what='one an expert'
        )
        self.n_inputs_, self.n_outputs_ = pairs.inputs.shape[1], pairs.targets.shape[1]
        self._scaling = Standardisation.of(pairs.inputs, pairs.weights, self.scaling)
        self._target_scaling = Standardisation.of(pairs.targets, pairs.weights)
        self._prior = self._regression_prior()
        if responsibilities is not None:
            given = np.asarray(responsibilities, dtype=np.float64)
            wanted = (len(np.atleast_1d(np.asarray(inputs))), self.n_experts)
            if given.shape != wanted or not np.isfinite(given).all() or (given < 0).any():
                raise ValueError(
                    f'responsibilities of shape {given.shape}, wanted {wanted}, finite and >= 0'
                )
            if sample_weight is not None:
                given = given[np.asarray(sample_weight) > 0]
            basis = self._bases(pairs)[0]
            start = given / np.maximum(given.sum(1, keepdims=True), 1e-300)
            data, state = self._begin(pairs, basis, start)
        else:
            basis, data, state = self._best_start(pairs)
        self.basis_ = basis
        state, bounds, self.responsibilities_ = climb(
            data, state, self._expert, self.max_iterations, self.tolerance
        )
        self.experts_, self.gates_ = state.experts, state.gates
        self.bound_ = np.array(bounds)
        self.inflation_ = 1.0
        self._keep_used()
        return self

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p)."""
        points = self._checked(inputs)
        features = self.basis_.evaluate(points)
        scores = self.gates_.log_scores(self.gates_.features(points))
        log_weights = log_softmax(scores)
        means = (features @ self._stacked).reshape(len(points), self.n_experts_, self.n_outputs_)
        means = means * self._target_scaling.scale + self._target_scaling.centre
        inflation = np.stack([1.0 + one.spread(features) for one in self.experts_], axis=1)
        inflation *= self.inflation_
        return Components(log_weights, means, inflation, self._noise)

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the experts' means by the input."""
        points = self._checked(inputs)
        flat = self.basis_.jacobians(points, self._stacked)
        shape = (len(points), self.n_experts_, self.n_outputs_, self.n_inputs_)
        return flat.reshape(shape) * self._target_scaling.scale[:, None]

    def support(self, inputs: ArrayLike) -> Array:
        """Largest kernel at each input, (n,); for linear experts exp(-|z|^2 / 2p)."""
        points = self._scaling.apply(self._checked(inputs))
        if isinstance(self.basis_, RadialBasis):
            squares = squared_distances(points, self._candidates).min(1) / self.basis_.width**2
        else:
            squares = (points**2).mean(1)
        result: Array = np.exp(-0.5 * squares)
        return result

    def calibrate(self, inputs: ArrayLike, targets: ArrayLike) -> Self:
        """Scales all covariances by one factor, which makes samples not learned from most probable.

        Samples of one motion are alike, so that what was learned from some is too sure of others:
        these should come from motions, or people, apart.

        Args:
            inputs: (n, p).
            targets: (n, D).

        Raises:
            ValueError: wrong shapes, values that are not finite.
        """
        self.inflation_ = 1.0
        found = self.components(inputs)
        targets = checked_pairs(inputs, targets).targets

        def loss(log_factor: float) -> float:
            inflation = np.exp(log_factor) * found.inflation
            return -float(replace(found, inflation=inflation).log_density(targets).mean())

        best = minimize_scalar(loss, bounds=(-2.0, 5.0), method='bounded')
        self.inflation_ = float(np.exp(best.x))
        return self

    # ---- learning

    def _check_parameters(self) -> None:
        checked_scaling(self.scaling)
        for name, value, least in (
            ('n_experts', self.n_experts, 1),
            ('max_kernels', self.max_kernels, 1),
            ('n_starts', self.n_starts, 1),
            ('max_iterations', self.max_iterations, 1),
        ):
            if value < least:
                raise ValueError(f'{name} is {value}, wanted at least {least}')
        if self.basis not in BASES:
            raise ValueError(f'basis is {self.basis!r}, wanted one of {", ".join(BASES)}')
        if self.learning not in LEARNING:
            raise ValueError(f'learning is {self.learning!r}, wanted one of {", ".join(LEARNING)}')
        if self.learning == 'maximum_likelihood' and self.basis != 'linear':
            raise ValueError(
                f"learning is 'maximum_likelihood' with basis {self.basis!r}, which needs a prior; "
                "wanted basis='linear'"
            )
        if self.width is not None and not self.width > 0:
            raise ValueError(f'width is {self.width}, wanted a positive number or None')

    def _regression_prior(self) -> RegressionPrior:
        strength = 0.0 if self.learning == 'maximum_likelihood' else self.n_outputs_ + 3.0
        return RegressionPrior(strength, strength * NOISE_FLOOR * np.eye(self.n_outputs_))

    def _bases(self, pairs: TrainingPairs) -> list[Basis]:
        """Candidates with each width that is to be tried."""
        if self.basis == 'linear':
            return [LinearBasis(self._scaling)]
        rng = np.random.default_rng(self.seed)
        points = self._scaling.apply(pairs.inputs)
        distance = typical_distance(points, rng)
        centres = points[spread_centres(points, self.max_kernels, rng)]
        widths = [share * distance for share in WIDTHS] if self.width is None else [self.width]
        return [RadialBasis(self._scaling, centres, width) for width in widths]

    def _begin(self, pairs: TrainingPairs, basis: Basis, first: Array) -> tuple[EMData, EMState]:
        gates = self._first_gates(basis, pairs, self._scaling)
        data = EMData(
            basis.evaluate(pairs.inputs),
            self._target_scaling.apply(pairs.targets),
            pairs.weights,
        )
        state = EMState((), gates, gates.features(pairs.inputs), -np.inf)
        return data, m_step(data, state, first, self._expert)

    def _best_start(self, pairs: TrainingPairs) -> tuple[Basis, EMData, EMState]:
        """The start with the highest bound after a few iterations."""
        rng = np.random.default_rng(self.seed)
        some = pairs
        if len(pairs) > TRIAL_SAMPLES:
            some = pairs[np.sort(rng.permutation(len(pairs))[:TRIAL_SAMPLES])]
        starts = [self._first_responsibilities(some, k, rng) for k in range(self.n_starts)]
        trials = [
            (basis, *self._begin(some, basis, start))
            for basis in self._bases(pairs)
            for start in starts
        ]
        # Half of them are given up after each round.
        for iterations in TRIAL_ITERATIONS:
            trials = [
                (basis, data, climb(data, state, self._expert, iterations, self.tolerance)[0])
                for basis, data, state in trials
            ]
            trials.sort(key=lambda trial: -trial[2].bound)
            trials = trials[: (len(trials) + 1) // 2]
        basis, _, state = trials[0]
        gate_features = state.gates.features(pairs.inputs)
        data = EMData(
            basis.evaluate(pairs.inputs),
            self._target_scaling.apply(pairs.targets),
            pairs.weights,
        )
        state = EMState(state.experts, state.gates, gate_features, -np.inf)
        return basis, data, m_step(data, state, e_step(data, state), self._expert)

    def _first_responsibilities(
        self, pairs: TrainingPairs, number: int, rng: np.random.Generator
    ) -> Array:
        """Clusters of inputs and targets together, in which targets count more or less."""
        inputs = self._scaling.apply(pairs.inputs)
        targets = self._target_scaling.apply(pairs.targets)
        share = (0.5, 0.7, 0.9, 0.3)[number % 4]
        points = np.hstack(
            [
                np.sqrt((1 - share) / inputs.shape[1]) * inputs,
                np.sqrt(share / targets.shape[1]) * targets,
            ]
        )
        labels = clusters(points, pairs.weights, self.n_experts, rng)
        result = np.full((len(pairs), self.n_experts), 0.02 / self.n_experts)
        result[np.arange(len(pairs)), labels] += 0.98
        return result

    def _expert(self, sums: WeightedSums, old: SparseRegression | None) -> SparseRegression:
        if self.learning == 'maximum_likelihood':
            return maximum_likelihood(sums)
        return maximise_evidence(sums, self._prior, old, rounds=6 if old is None else 3)

    # ---- what is learned

    def _keep_used(self) -> None:
        """Leaves kernels out that no expert uses, and prepares what predictions need."""
        if isinstance(self.basis_, RadialBasis):
            self._candidates = self.basis_.centres
            self.width_ = self.basis_.width
            used = np.unique(np.concatenate([one.active for one in self.experts_] + [[0]]))
            used = used.astype(np.intp)
            self.basis_ = self.basis_.subset(used[used > 0] - 1)
            self.experts_ = tuple(
                SparseRegression(
                    np.searchsorted(used, one.active), one.precisions, one.weights,
                    one.covariance, one.noise, one.evidence,
                )
                for one in self.experts_
            )  # fmt: skip
        self._prepare()

    def _prepare(self) -> None:
        self.n_experts_ = len(self.experts_)
        stacked = np.zeros((len(self.basis_), self.n_experts_, self.n_outputs_))
        for i, one in enumerate(self.experts_):
            stacked[one.active, i] = one.weights
        self._stacked = stacked.reshape(len(self.basis_), -1)
        scale = self._target_scaling.scale
        self._noise = np.array([one.noise * scale[:, None] * scale for one in self.experts_])

    def _learned(self) -> Arrays:
        arrays: Arrays = {
            'input_centre': self._scaling.centre,
            'input_scale': self._scaling.scale,
            'target_centre': self._target_scaling.centre,
            'target_scale': self._target_scaling.scale,
            'n_experts': np.array(self.n_experts_),
            'inflation': np.array(self.inflation_),
        }
        if isinstance(self.basis_, RadialBasis):
            arrays['candidates'] = self._candidates
        for i, one in enumerate(self.experts_):
            arrays |= nested(
                f'expert{i}',
                {
                    'active': one.active,
                    'precisions': one.precisions,
                    'weights': one.weights,
                    'covariance': one.covariance,
                    'noise': one.noise,
                },
            )
        return (
            arrays | nested('basis', self.basis_.arrays()) | nested('gates', self.gates_.arrays())
        )

    def _set_learned(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        self._scaling = Standardisation(arrays['input_centre'], arrays['input_scale'])
        self._target_scaling = Standardisation(arrays['target_centre'], arrays['target_scale'])
        self.basis_ = basis_of(part('basis', arrays))
        if isinstance(self.basis_, RadialBasis):
            self._candidates = np.asarray(arrays['candidates'])
            self.width_ = self.basis_.width
        experts = []
        for i in range(int(arrays['n_experts'])):
            own = part(f'expert{i}', arrays)
            experts.append(
                SparseRegression(
                    own['active'], own['precisions'], own['weights'], own['covariance'],
                    own['noise'], np.nan,
                )
            )  # fmt: skip
        self.experts_ = tuple(experts)
        self.inflation_ = float(arrays['inflation'])
        self.gates_ = self._gates_of(part('gates', arrays))
        self._prepare()
