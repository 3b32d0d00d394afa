"""Weighted nearest neighbours: the yardstick that needs no learning (BME 3, comparisons).

    p(x | r) = sum_k w_k N(x; x_k, O),    w_k proportional to 1 / |r - r_k|

over the K nearest training inputs. O is the covariance of what a training target lacks of the
targets of its own neighbours, so that the density is as wide as the neighbours are wrong.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from hmt_ros.experts.conditional_density import Components, ConditionalDensity
from hmt_ros.experts.model_file import Arrays
from hmt_ros.experts.training_pairs import (
    Standardisation,
    TrainingPairs,
    checked_pairs,
    checked_scaling,
)

if TYPE_CHECKING:
    from typing_extensions import Self

Array = NDArray[np.float64]

# Distances below this part of the typical one count as equal, else one neighbour has it all.
CLOSEST = 1e-3
# Part of the targets' variance that is added to the covariance.
RIDGE = 1e-6


class NearestNeighbours(ConditionalDensity):
    """The targets of the nearest inputs, weighted by inverse distance.

    Args:
        n_neighbours: K, at most the number of samples less one.
        scaling: of inputs before distances are taken, 'each' column or one 'common' scale.

    Attributes:
        inputs_, targets_, sample_weight_: (N, p), (N, D), (N,) of the training set.
        noise_: (D, D) O.
        spacing_: root mean squared distance of a training input to its K neighbours, scaled.
    """

    kind = 'nearest_neighbours'

    def __init__(self, n_neighbours: int = 5, scaling: str = 'each') -> None:
        self.n_neighbours = n_neighbours
        self.scaling = scaling

    def fit(
        self, inputs: ArrayLike, targets: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Keeps the samples; see `ConditionalDensity.fit`."""
        checked_scaling(self.scaling)
        if self.n_neighbours < 1:
            raise ValueError(f'n_neighbours is {self.n_neighbours}, wanted at least 1')
        pairs = checked_pairs(
            inputs, targets, sample_weight,
            at_least=self.n_neighbours + 1, what='one more than neighbours',
        )  # fmt: skip
        self.n_inputs_, self.n_outputs_ = pairs.inputs.shape[1], pairs.targets.shape[1]
        self._keep(pairs, Standardisation.of(pairs.inputs, pairs.weights, self.scaling))
        self.spacing_ = 1.0
        distances, index = self._tree.query(self._scaled, self.n_neighbours + 1)
        # A sample is its own neighbour, though not always the first where inputs are equal.
        own = index == np.arange(len(pairs))[:, None]
        own[~own.any(1), -1] = True
        shape = (len(pairs), self.n_neighbours)
        distances, index = distances[~own].reshape(shape), index[~own].reshape(shape)
        self.spacing_ = max(float(np.sqrt((distances**2).mean())), np.finfo(float).tiny)
        lack = pairs.targets[:, None] - pairs.targets[index]
        share = self._shares(distances, index) * (pairs.weights / pairs.weights.sum())[:, None]
        noise = np.einsum('nk,nki,nkj->ij', share, lack, lack, optimize=True)
        offsets = pairs.targets - pairs.targets.mean(0)
        ridge = RIDGE * max(float((offsets**2).mean()), np.finfo(float).eps)
        self.noise_ = noise + ridge * np.eye(self.n_outputs_)
        return self

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p), nearest neighbour first."""
        points = self._standardisation.apply(self._checked(inputs))
        distances, index = self._tree.query(points, self.n_neighbours)
        distances, index = distances.reshape(len(points), -1), index.reshape(len(points), -1)
        shares = self._shares(distances, index)
        noise = np.broadcast_to(self.noise_, (self.n_neighbours, *self.noise_.shape))
        return Components(np.log(shares), self.targets_[index], np.ones_like(shares), noise)

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Zeros (n, K, D, p): the neighbours' targets do not move with the input."""
        points = self._checked(inputs)
        return np.zeros((len(points), self.n_neighbours, self.n_outputs_, self.n_inputs_))

    def support(self, inputs: ArrayLike) -> Array:
        """exp(-(d / s)^2 / 2), (n,): d to the nearest neighbour, s the spacing of the samples."""
        points = self._standardisation.apply(self._checked(inputs))
        distances, _ = self._tree.query(points, 1)
        result: Array = np.exp(-0.5 * (distances / self.spacing_) ** 2)
        return result

    def _shares(self, distances: Array, index: NDArray[np.intp]) -> Array:
        closeness = 1.0 / np.maximum(distances, CLOSEST * self.spacing_)
        closeness *= self.sample_weight_[index]
        result: Array = closeness / closeness.sum(1, keepdims=True)
        return result

    def _keep(self, pairs: TrainingPairs, standardisation: Standardisation) -> None:
        self.inputs_, self.targets_ = pairs.inputs, pairs.targets
        self.sample_weight_ = pairs.weights
        self._standardisation = standardisation
        self._scaled = standardisation.apply(pairs.inputs)
        self._tree = cKDTree(self._scaled)

    def _learned(self) -> Arrays:
        return {
            'inputs': self.inputs_,
            'targets': self.targets_,
            'sample_weight': self.sample_weight_,
            'centre': self._standardisation.centre,
            'scale': self._standardisation.scale,
            'noise': self.noise_,
            'spacing': np.array(self.spacing_),
        }

    def _set_learned(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        pairs = TrainingPairs(arrays['inputs'], arrays['targets'], arrays['sample_weight'])
        self._keep(pairs, Standardisation(arrays['centre'], arrays['scale']))
        self.noise_ = np.asarray(arrays['noise'], dtype=np.float64)
        self.spacing_ = float(arrays['spacing'])
