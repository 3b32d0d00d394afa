"""Mixtures of sparse Bayesian experts: the conditional and the joint BME.

    p(x | r) = sum_i g_i(r) N(x; M_i' phi(r), O_i (1 + phi' S_i phi))           (BME 14 and 31)

`ConditionalExperts` have softmax gates (BME 16), `JointExperts` Gaussian gates (BME 32). A model
with one expert is sparse Bayesian regression, the single-mode baseline of BME 3. All are trained by
`expectation_maximisation`.

Several starts, each with all candidate kernel widths, run for a few iterations on a subset of the
samples; the start with the highest bound continues with all samples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.learned_file import (
    Arrays,
    check_covariances,
    nested,
    part,
    require,
)
from hmt_ros.core import elementary
from hmt_ros.experts.basis import (
    BASES,
    Basis,
    LinearBasis,
    RadialBasis,
    basis_of,
    typical_distance,
)
from hmt_ros.experts.conditional_density import Components, ConditionalDensity
from hmt_ros.experts.expectation_maximisation import EMState, climb, e_step, m_step
from hmt_ros.experts.gates import Gates, GaussianGates, SoftmaxGates, log_softmax
from hmt_ros.experts.sparse_bayes import (
    RegressionPrior,
    SparseRegression,
    WeightedSums,
    maximise_evidence,
)
from hmt_ros.experts.training_pairs import Standardisation, TrainingPairs, checked_pairs
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.clustering import k_means, spread_points, squared_distances
from hmt_ros.inference.linear_algebra import product

if TYPE_CHECKING:
    from typing_extensions import Self


# Candidate kernel widths, in typical distances between inputs.
WIDTHS = (0.5, 1.0, 2.0)
# Number of EM iterations in each round that selects a start; maximum number of samples.
TRIAL_ITERATIONS = (2, 4, 8)
TRIAL_SAMPLES = 1000
# Noise variance preferred by the prior, relative to the targets' variance.
NOISE_FLOOR = 1e-2
# Maximum number of experts in a file, and of basis functions of an expert.
MAX_EXPERTS, MAX_ACTIVE_FUNCTIONS = 1000, 2000
# Tolerance for rounding errors in correlations of weights: covariances span many orders of
# magnitude.
SEMIDEFINITE_TOLERANCE = 1e-6


class ExpertMixture(ConditionalDensity):
    """M sparse Bayesian regressions and their gates.

    Args:
        n_experts: Number of experts M at the start; experts without samples are pruned.
        basis: Basis functions of experts and gates: 'linear' or 'rbf' (Gaussian kernels).
        width: Width of the kernels, in units of scaled inputs; None chooses among candidates.
        max_kernels: Maximum number of candidate kernels, spread over the training inputs.
        n_starts: Number of initialisations of EM for each width.
        tolerance: Gain of an iteration below which EM ends, nats per sample.
        scaling: Scaling of inputs before distances are computed; see `Standardisation.of`.

    Attributes:
        n_experts_: Number of experts that remain.
        basis_: Basis functions phi that at least one expert uses.
        experts_: Regressions of the experts, in units of standardised targets.
        gates_: Gates of the experts.
        bound_: Bound F, nats, after each iteration since the last pruning of an expert.
    """

    n_experts_: int
    basis_: Basis
    experts_: tuple[SparseRegression, ...]
    gates_: Gates
    bound_: Array
    _gates: ClassVar[type[Gates]]

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

    def fit(
        self, inputs: ArrayLike, targets: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Fit the model to inputs (N, p) and targets (N, D).

        Args:
            sample_weight: (N,) nonnegative weights; a sample of weight 2 counts as two equal
                samples.

        Raises:
            ValueError: shapes are wrong, values are not finite, there are fewer samples than
                experts, or parameters are out of their range.
        """
        self._check_parameters()
        pairs = checked_pairs(
            inputs, targets, sample_weight, at_least=self.n_experts, what='one an expert'
        )
        self.n_inputs_, self.n_outputs_ = pairs.inputs.shape[1], pairs.targets.shape[1]
        self._scaling = Standardisation.of(pairs.inputs, pairs.weights, self.scaling)
        self._target_scaling = Standardisation.of(pairs.targets, pairs.weights)
        strength = self.n_outputs_ + 3.0
        self._prior = RegressionPrior(strength, strength * NOISE_FLOOR * np.eye(self.n_outputs_))
        self.basis_, features, state = self._best_start(pairs)
        state, bounds = climb(features, state, self._expert, self.max_iterations, self.tolerance)
        self.experts_, self.gates_ = state.experts, state.gates
        self.bound_ = np.array(bounds)
        self._keep_used()
        return self

    def components(self, inputs: ArrayLike) -> Components:
        """Return the mixtures at inputs (n, p)."""
        points = self._checked(inputs)
        features = self.basis_.evaluate(points)
        scores = self.gates_.log_scores(self.gates_.features(points))
        log_weights = log_softmax(scores)
        means = product(features, self._stacked).reshape(
            len(points), self.n_experts_, self.n_outputs_
        )
        means = means * self._target_scaling.scale + self._target_scaling.centre
        inflation = np.stack([1.0 + one.spread(features) for one in self.experts_], axis=1)
        return Components(log_weights, means, inflation, self._noise)

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the experts' means with respect to the input."""
        points = self._checked(inputs)
        flat = self.basis_.jacobians(points, self._stacked)
        shape = (len(points), self.n_experts_, self.n_outputs_, self.n_inputs_)
        return flat.reshape(shape) * self._target_scaling.scale[:, None]

    def support(self, inputs: ArrayLike) -> Array:
        """Largest kernel value at each input, (n,); for linear experts exp(-|z|^2 / 2p)."""
        points = self._scaling.apply(self._checked(inputs))
        if isinstance(self.basis_, RadialBasis):
            squares = squared_distances(points, self._candidates).min(1) / self.basis_.width**2
        else:
            squares = (points**2).mean(1)
        return np.asarray(elementary.exp(-0.5 * squares))

    # Learning.

    def _check_parameters(self) -> None:
        for name in ('n_experts', 'max_kernels', 'n_starts', 'max_iterations'):
            value = getattr(self, name)
            require(value >= 1, f'{name} is {value}, wanted at least 1')
        require(self.basis in BASES, f'basis is {self.basis!r}, wanted one of {", ".join(BASES)}')
        right = self.width is None or self.width > 0
        require(right, f'width is {self.width}, wanted a positive number or None')

    def _bases(self, pairs: TrainingPairs) -> list[Basis]:
        """Return the candidate basis functions for each candidate width."""
        if self.basis == 'linear':
            return [LinearBasis(self._scaling)]
        rng = np.random.default_rng(self.seed)
        points = self._scaling.apply(pairs.inputs)
        distance = typical_distance(points, rng)
        centres = points[spread_points(points, self.max_kernels, rng)]
        widths = [share * distance for share in WIDTHS] if self.width is None else [self.width]
        return [RadialBasis(self._scaling, centres, width) for width in widths]

    def _features(self, pairs: TrainingPairs, basis: Basis) -> TrainingPairs:
        """Evaluate the basis at the inputs, and standardise the targets."""
        targets = self._target_scaling.apply(pairs.targets)
        return TrainingPairs(basis.evaluate(pairs.inputs), targets, pairs.weights)

    def _begin(
        self, pairs: TrainingPairs, basis: Basis, first: Array
    ) -> tuple[TrainingPairs, EMState]:
        """Return the features, and the state after an M-step from the first responsibilities."""
        gates = self._gates.first(self.n_experts, basis, pairs, self._scaling)
        features = self._features(pairs, basis)
        state = EMState((), gates, gates.features(pairs.inputs), -np.inf)
        return features, m_step(features, state, first, self._expert)

    def _best_start(self, pairs: TrainingPairs) -> tuple[Basis, TrainingPairs, EMState]:
        """Return the start with the highest bound after a few iterations."""
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
        # Each round drops half of the starts.
        for iterations in TRIAL_ITERATIONS:
            trials = [
                (basis, data, climb(data, state, self._expert, iterations, self.tolerance)[0])
                for basis, data, state in trials
            ]
            trials.sort(key=lambda trial: -trial[2].bound)
            trials = trials[: (len(trials) + 1) // 2]
        basis, _, state = trials[0]
        features = self._features(pairs, basis)
        gate_features = state.gates.features(pairs.inputs)
        state = EMState(state.experts, state.gates, gate_features, -np.inf)
        return basis, features, m_step(features, state, e_step(features, state), self._expert)

    def _first_responsibilities(
        self, pairs: TrainingPairs, number: int, rng: np.random.Generator
    ) -> Array:
        """Responsibilities (N, M) from clusters; `number` selects the weight of the targets."""
        inputs = self._scaling.apply(pairs.inputs)
        targets = self._target_scaling.apply(pairs.targets)
        share = (0.5, 0.7, 0.9, 0.3)[number % 4]
        points = np.hstack(
            [
                np.sqrt((1 - share) / inputs.shape[1]) * inputs,
                np.sqrt(share / targets.shape[1]) * targets,
            ]
        )
        labels = k_means(points, self.n_experts, rng)[1]
        result = np.full((len(pairs), self.n_experts), 0.02 / self.n_experts)
        result[np.arange(len(pairs)), labels] += 0.98
        return result

    def _expert(self, sums: WeightedSums, old: SparseRegression | None) -> SparseRegression:
        return maximise_evidence(sums, self._prior, old, rounds=6 if old is None else 3)

    # Predictions and files.

    def _keep_used(self) -> None:
        """Drop kernels that no expert uses, and prepare predictions."""
        if isinstance(self.basis_, RadialBasis):
            self._candidates = self.basis_.centres
            used = np.unique(np.concatenate([one.active for one in self.experts_] + [[0]]))
            used = used.astype(np.intp)
            self.basis_ = self.basis_.subset(used[used > 0] - 1)
            self.experts_ = tuple(
                replace(one, active=np.searchsorted(used, one.active)) for one in self.experts_
            )
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
        count = int(arrays['n_experts'])
        require(1 <= count <= MAX_EXPERTS, f'{count} experts, wanted 1 to {MAX_EXPERTS}')
        self._scaling = Standardisation(arrays['input_centre'], arrays['input_scale'])
        self._target_scaling = Standardisation(arrays['target_centre'], arrays['target_scale'])
        self.basis_ = basis_of(part('basis', arrays))
        if isinstance(self.basis_, RadialBasis):
            self._candidates = arrays['candidates']
        self.experts_ = tuple(_stored_expert(part(f'expert{i}', arrays)) for i in range(count))
        self.gates_ = self._gates.of_arrays(part('gates', arrays))
        self._prepare()


class ConditionalExperts(ExpertMixture):
    """The conditional BME (BME 2.2.2): the gates are a softmax of the input, g = softmax(V phi(r)).

    Arguments and attributes are as in `ExpertMixture`.
    """

    kind = 'conditional_experts'
    _gates = SoftmaxGates


class JointExperts(ExpertMixture):
    """The joint BME (BME 2.2.3): a mixture over inputs and targets jointly.

        p(x, r) = sum_i a_i N(r; m_i, C_i) N(x; W_i phi(r), O_i)                    (BME 33)

    Arguments and attributes are as in `ExpertMixture`.
    """

    kind = 'joint_experts'
    _gates = GaussianGates


def _stored_expert(own: Mapping[str, NDArray[Any]]) -> SparseRegression:
    """Read the regression of an expert; ValueError if its functions or covariances are invalid."""
    active, covariance = own['active'], own['covariance']
    m = len(active)
    different = m == len(np.unique(active)) <= MAX_ACTIVE_FUNCTIONS and (active >= 0).all()
    require(different, f'an expert names functions twice, or more than {MAX_ACTIVE_FUNCTIONS}')
    check_covariances('the covariance of weights', covariance, SEMIDEFINITE_TOLERANCE)
    return SparseRegression(
        active, own['precisions'], own['weights'], covariance, own['noise'], np.nan
    )
