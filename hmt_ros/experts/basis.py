"""Basis functions phi(r) of the experts and gates: linear, or Gaussian kernels (BME 2.2).

Both standardise the inputs, so callers pass inputs in the units of the data. In both, the first
function is the constant 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.learned_file import Arrays, check_positive
from hmt_ros.core import elementary
from hmt_ros.experts.training_pairs import Standardisation
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.clustering import squared_distances
from hmt_ros.inference.linear_algebra import product

BASES = ('linear', 'rbf')


@dataclass(frozen=True, eq=False)
class LinearBasis:
    """phi(r) = (1, z_1, ..., z_p) with the standardised input z."""

    standardisation: Standardisation

    def __len__(self) -> int:
        return 1 + len(self.standardisation.centre)

    def evaluate(self, inputs: Array) -> Array:
        """phi (n, 1 + p) at inputs (n, p)."""
        return np.hstack([np.ones((len(inputs), 1)), self.standardisation.apply(inputs)])

    def jacobians(self, inputs: Array, weights: Array) -> Array:
        """Derivatives (n, D, p) of W' phi(r) at inputs (n, p), with weights W (1 + p, D)."""
        slope: Array = weights[1:].T / self.standardisation.scale
        return np.broadcast_to(slope, (len(inputs), *slope.shape)).copy()

    def arrays(self) -> Arrays:
        """Arrays for a file."""
        return {'centre': self.standardisation.centre, 'scale': self.standardisation.scale}


@dataclass(frozen=True, eq=False)
class RadialBasis:
    """phi(r) = (1, k_1, ..., k_K), k_j = exp(-|z - c_j|^2 / (2 width^2)).

    Attributes:
        standardisation: Maps inputs r to z.
        centres: (K, p) standardised centres c.
        width: Standard deviation of the kernels, in units of z.
    """

    standardisation: Standardisation
    centres: Array
    width: float

    def __len__(self) -> int:
        return 1 + len(self.centres)

    def evaluate(self, inputs: Array) -> Array:
        """phi (n, 1 + K) at inputs (n, p)."""
        result = np.empty((len(inputs), len(self)))
        result[:, 0] = 1.0
        squares = squared_distances(self.standardisation.apply(inputs), self.centres)
        elementary.exp(squares * (-0.5 / self.width**2), out=result[:, 1:])
        return result

    def jacobians(self, inputs: Array, weights: Array) -> Array:
        """Derivatives (n, D, p) of W' phi(r) at inputs (n, p), with weights W (1 + K, D).

        sum_j w_j dk_j / dr = sum_j w_j k_j (c_j - z) / (width^2 scale)
        """
        z = self.standardisation.apply(inputs)
        kernels = self.evaluate(inputs)[:, 1:]
        total = product(kernels, weights[1:])
        pull = product(kernels[:, None] * weights[1:].T, self.centres)
        return np.asarray(
            (pull - total[:, :, None] * z[:, None]) / (self.width**2 * self.standardisation.scale)
        )

    def subset(self, kernels: NDArray[np.intp]) -> RadialBasis:
        """Return the basis with the constant and only some of the K kernels."""
        return RadialBasis(self.standardisation, self.centres[kernels], self.width)

    def arrays(self) -> Arrays:
        """Arrays for a file."""
        return {
            'centre': self.standardisation.centre,
            'scale': self.standardisation.scale,
            'centres': self.centres,
            'width': np.array(self.width),
        }


Basis = LinearBasis | RadialBasis


def basis_of(arrays: Mapping[str, NDArray[Any]]) -> Basis:
    """The basis that `arrays` describes.

    Raises:
        ValueError: the width or a scale is not positive.
    """
    standardisation = Standardisation(arrays['centre'], arrays['scale'])
    if 'centres' in arrays:
        check_positive('width', arrays['width'])
        return RadialBasis(standardisation, arrays['centres'], float(arrays['width']))
    return LinearBasis(standardisation)


def typical_distance(points: Array, rng: np.random.Generator, sample: int = 500) -> float:
    """Root mean squared distance between two of the points (N, p)."""
    some = points if len(points) <= sample else points[rng.permutation(len(points))[:sample]]
    return float(np.sqrt(max(squared_distances(some, some).mean(), 1e-12)))
