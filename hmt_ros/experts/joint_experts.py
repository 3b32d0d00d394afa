"""The mixture of experts over inputs and targets together (BME 2.2.3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.experts.basis import Basis
from hmt_ros.experts.expectation_maximisation import Gates
from hmt_ros.experts.expert_mixture import ExpertMixture
from hmt_ros.experts.gates import GaussianGates
from hmt_ros.experts.training_pairs import Standardisation, TrainingPairs


class JointExperts(ExpertMixture):
    """Experts whose inputs are Gaussian: p(x, r) = sum_i a_i N(r; m_i, C_i) N(x; W_i phi(r), O_i).

    The conditional has gates proportional to a_i N(r; m_i, C_i). Arguments and attributes are those
    of `ExpertMixture`.
    """

    kind = 'joint_experts'

    def _first_gates(self, basis: Basis, pairs: TrainingPairs, scaling: Standardisation) -> Gates:
        p = pairs.inputs.shape[1]
        share = pairs.weights / pairs.weights.sum()
        z = scaling.apply(pairs.inputs)
        spread = z - share @ z
        variances = np.maximum(share @ spread**2, 1e-6)
        # Experts divide the space of inputs between them.
        target = np.diag(variances) * self.n_experts ** (-2.0 / p)
        strength = 0.0 if self.learning == 'maximum_likelihood' else p + 1.0
        return GaussianGates(
            scaling,
            np.full(self.n_experts, -np.log(self.n_experts)),
            np.zeros((self.n_experts, p)),
            np.broadcast_to(target, (self.n_experts, p, p)).copy(),
            strength,
            target,
            0.0,
        )

    def _gates_of(self, arrays: Mapping[str, NDArray[Any]]) -> Gates:
        return GaussianGates.of_arrays(arrays)
