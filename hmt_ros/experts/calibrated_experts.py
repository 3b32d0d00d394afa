"""Experts whose gates and covariances are calibrated on held-out motions.

    p(x | r) ~ sum_i g_i(r)^(1 / T) N(x; f_i(r), c_i(r) s (O_i + E))

The frames of one motion are similar, so a model is overconfident about other motions: in high
dimensions its gates are too sharp, and its covariances fit only the training motions. The
temperature T of the gates, the added covariance E and the factor s are learned by
`hmt_learning.training.calibration_learning`; this module applies them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.learned_file import MAX_POSITIVE, Arrays, nested, parameters_of, part, require
from hmt_ros.experts.conditional_density import Components, ConditionalDensity, stored_model
from hmt_ros.experts.gates import log_softmax
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import symmetric_eigenvalues

if TYPE_CHECKING:
    from typing_extensions import Self


FOLDS = 3


@dataclass(frozen=True, eq=False)
class Calibration:
    """Correction of the gates and covariances of a model.

    Attributes:
        temperature: Temperature T of the gates, at least 1.
        added: (D, D) added covariance E, positive semidefinite.
        factor: Factor s of the covariances, at least 1.

    Raises:
        ValueError: a value is out of its range.
    """

    temperature: float
    added: Array
    factor: float

    def __post_init__(self) -> None:
        size = len(self.added)
        require(self.added.shape == (size, size), 'added must be (D, D)')
        least, largest = symmetric_eigenvalues(self.added)[[0, -1]]
        same = np.allclose(self.added, self.added.T)
        require(same and least >= -1e-9 * largest, 'added must be positive semidefinite')
        for name in ('temperature', 'factor'):
            require(1.0 <= getattr(self, name) <= MAX_POSITIVE, f'{name} must be at least 1')

    def of(self, found: Components) -> Components:
        """Apply the calibration to mixtures."""
        return replace(
            found,
            log_weights=log_softmax(found.log_weights / self.temperature),
            noise=self.factor * (found.noise + self.added),
        )


class CalibratedExperts(ConditionalDensity):
    """A model with gates and covariances calibrated on held-out motions; for prediction only.

    Args:
        folds: Number of cross-validation folds over the motions.
    """

    kind = 'calibrated_experts'

    calibration_: Calibration

    def __init__(self, model: ConditionalDensity, folds: int = FOLDS) -> None:
        self.model = model
        self.folds = folds

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p)."""
        self._check_learned()
        return self.calibration_.of(self.model.components(inputs))

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the components' means with respect to the input."""
        return self.model.jacobians(inputs)

    def support(self, inputs: ArrayLike) -> Array:
        """Similarity (n,) of inputs (n, p) to the training data, from the wrapped model."""
        return self.model.support(inputs)

    def _stored_parameters(self) -> dict[str, Any]:
        return {'folds': self.folds}

    @classmethod
    def _constructed(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        own = part('model', arrays)
        # Refuse nesting, because a file could nest models endlessly.
        require(str(own['kind']) != cls.kind, 'a calibrated model inside a calibrated model')
        return cls(stored_model(own), **parameters_of(arrays))

    def _learned(self) -> Arrays:
        found = self.calibration_
        return {
            'temperature': np.array(found.temperature),
            'added': found.added,
            'factor': np.array(found.factor),
        } | nested('model', self.model.to_arrays())

    def _set_learned(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        same = (self.model.n_inputs_, self.model.n_outputs_) == (self.n_inputs_, self.n_outputs_)
        require(same, 'its model has other inputs or outputs')
        self.calibration_ = Calibration(
            float(arrays['temperature']),
            np.asarray(arrays['added'], dtype=np.float64),
            float(arrays['factor']),
        )
