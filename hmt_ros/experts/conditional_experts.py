"""The conditional Bayesian mixture of experts (BME 2.2.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.experts.basis import Basis, RadialBasis
from hmt_ros.experts.expectation_maximisation import Gates
from hmt_ros.experts.expert_mixture import ExpertMixture
from hmt_ros.experts.gates import SoftmaxGates
from hmt_ros.experts.training_pairs import Standardisation, TrainingPairs

# Kernels of the gates at the start: at most so many, and at most one for so many samples.
GATE_KERNELS, SAMPLES_PER_KERNEL = 60, 15


class ConditionalExperts(ExpertMixture):
    """Experts whose gates are a softmax of the input, g = softmax(V phi(r)).

    Arguments and attributes are those of `ExpertMixture`.
    """

    kind = 'conditional_experts'

    def _first_gates(self, basis: Basis, pairs: TrainingPairs, scaling: Standardisation) -> Gates:
        if isinstance(basis, RadialBasis):
            count = min(GATE_KERNELS, max(self.n_experts, len(pairs) // SAMPLES_PER_KERNEL))
            basis = basis.subset(np.arange(min(count, len(basis.centres))))
        return SoftmaxGates.flat(basis, self.n_experts)

    def _gates_of(self, arrays: Mapping[str, NDArray[Any]]) -> Gates:
        return SoftmaxGates.of_arrays(arrays)
