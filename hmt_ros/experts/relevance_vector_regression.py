"""One sparse Bayesian regression: the yardstick with a single mode (BME 3, comparisons)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from hmt_ros.experts.basis import Basis, LinearBasis
from hmt_ros.experts.expectation_maximisation import Gates
from hmt_ros.experts.expert_mixture import ExpertMixture
from hmt_ros.experts.gates import SoftmaxGates
from hmt_ros.experts.sparse_bayes import SparseRegression, WeightedSums, maximise_evidence
from hmt_ros.experts.training_pairs import Standardisation, TrainingPairs


class RelevanceVectorRegression(ExpertMixture):
    """p(x | r) = N(x; M' phi(r), O (1 + phi' S phi)): a mixture of one expert.

    Arguments and attributes are those of `ExpertMixture`, without those that choose experts.
    """

    kind = 'relevance_vector_regression'

    def __init__(
        self,
        basis: str = 'rbf',
        seed: int = 0,
        *,
        width: float | None = None,
        max_kernels: int = 400,
        max_iterations: int = 100,
        tolerance: float = 1e-4,
        scaling: str = 'each',
    ) -> None:
        super().__init__(
            1, basis, seed, width=width, max_kernels=max_kernels, n_starts=1,
            max_iterations=max_iterations, tolerance=tolerance, scaling=scaling,
        )  # fmt: skip

    def _first_gates(self, basis: Basis, pairs: TrainingPairs, scaling: Standardisation) -> Gates:
        return SoftmaxGates.flat(LinearBasis(scaling), 1)

    def _gates_of(self, arrays: Mapping[str, NDArray[Any]]) -> Gates:
        return SoftmaxGates.of_arrays(arrays)

    def _expert(self, sums: WeightedSums, old: SparseRegression | None) -> SparseRegression:
        return maximise_evidence(sums, self._prior, old)
