"""Basis functions phi(r) of the experts and gates: linear, or Gaussian kernels (BME 2.2).

Inputs are standardised inside, so that whoever calls works in units of the data. The first function
is the constant 1 in either case.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.experts.model_file import Arrays
from hmt_ros.experts.training_pairs import Standardisation

Array = NDArray[np.float64]
Index = NDArray[np.intp]

BASES = ('linear', 'rbf')


@dataclass(frozen=True, eq=False)
class LinearBasis:
    """phi(r) = (1, z_1, ..., z_p), z the standardised input."""

    standardisation: Standardisation

    def __len__(self) -> int:
        return 1 + len(self.standardisation.centre)

    def evaluate(self, inputs: Array) -> Array:
        """phi (n, 1 + p) at inputs (n, p)."""
        result: Array = np.hstack([np.ones((len(inputs), 1)), self.standardisation.apply(inputs)])
        return result

    def jacobians(self, inputs: Array, weights: Array) -> Array:
        """Derivatives (n, D, p) of weights' phi(r), weights (1 + p, D), at inputs (n, p)."""
        slope: Array = weights[1:].T / self.standardisation.scale
        return np.broadcast_to(slope, (len(inputs), *slope.shape)).copy()

    def arrays(self) -> Arrays:
        """For a file."""
        return {'centre': self.standardisation.centre, 'scale': self.standardisation.scale}


@dataclass(frozen=True, eq=False)
class RadialBasis:
    """phi(r) = (1, k_1, ..., k_K), k_j = exp(-|z - c_j|^2 / (2 width^2)).

    Attributes:
        standardisation: r -> z.
        centres: (K, p) c, standardised.
        width: in units of z.
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
        np.exp(squares * (-0.5 / self.width**2), out=result[:, 1:])
        return result

    def jacobians(self, inputs: Array, weights: Array) -> Array:
        """Derivatives (n, D, p) of weights' phi(r), weights (1 + K, D), at inputs (n, p).

        sum_j w_j dk_j / dr = sum_j w_j k_j (c_j - z) / (width^2 scale)
        """
        z = self.standardisation.apply(inputs)
        kernels = self.evaluate(inputs)[:, 1:]
        total = kernels @ weights[1:]
        pull = np.einsum('nk,kd,kp->ndp', kernels, weights[1:], self.centres, optimize=True)
        result: Array = (pull - total[:, :, None] * z[:, None]) / (
            self.width**2 * self.standardisation.scale
        )
        return result

    def subset(self, kernels: NDArray[np.intp]) -> RadialBasis:
        """The constant and some of the K kernels."""
        return RadialBasis(self.standardisation, self.centres[kernels], self.width)

    def arrays(self) -> Arrays:
        """For a file."""
        return {
            'centre': self.standardisation.centre,
            'scale': self.standardisation.scale,
            'centres': self.centres,
            'width': np.array(self.width),
        }


Basis = LinearBasis | RadialBasis


def basis_of(arrays: Mapping[str, NDArray[Any]]) -> Basis:
    """The basis whose `arrays` these are."""
    standardisation = Standardisation(arrays['centre'], arrays['scale'])
    if 'centres' in arrays:
        return RadialBasis(standardisation, arrays['centres'], float(arrays['width']))
    return LinearBasis(standardisation)


def squared_distances(a: Array, b: Array) -> Array:
    """|a_i - b_j|^2, (n, m), of points (n, p) and (m, p)."""
    squares = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * (a @ b.T)
    result: Array = np.maximum(squares, 0.0)
    return result


def spread_centres(points: Array, count: int, rng: np.random.Generator) -> Index:
    """Indices of at most `count` of the points (N, p), spread like the data.

    The seeds of k-means++: each next one is drawn in proportion to its squared distance to those
    before. Any opening of the sequence is itself spread. Equal points are taken once.
    """
    chosen = [int(rng.integers(len(points)))]
    distance = np.full(len(points), np.inf)
    floor = 1e-12 * max(float((points**2).sum(1).max()), 1e-300)
    while len(chosen) < min(count, len(points)):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(1))
        distance[distance <= floor] = 0.0
        total = distance.sum()
        if total <= 0:
            break
        chosen.append(int(np.searchsorted(np.cumsum(distance), total * rng.random())))
    return np.array(chosen)


def typical_distance(points: Array, rng: np.random.Generator, sample: int = 500) -> float:
    """Root mean squared distance between two of the points (N, p)."""
    some = points if len(points) <= sample else points[rng.permutation(len(points))[:sample]]
    return float(np.sqrt(max(squared_distances(some, some).mean(), 1e-12)))


def clusters(
    points: Array, weights: Array, count: int, rng: np.random.Generator, iterations: int = 30
) -> Index:
    """Labels (N,) of k-means clusters of points (N, p); the same generator, the same labels."""
    centres = points[spread_centres(points, count, rng)]
    labels: Index = np.zeros(len(points), dtype=np.intp)
    for _ in range(iterations):
        new = np.argmin(squared_distances(points, centres), axis=1)
        if (new == labels).all():
            break
        labels = new
        member = (labels[:, None] == np.arange(len(centres))) * weights[:, None]
        total = member.sum(0)
        full = total > 0
        centres[full] = (member.T @ points)[full] / total[full, None]
    return labels
