"""Experts that are made where they are needed: modes among the neighbours of an input.

    p(x | r) = sum_i g_i(r) N(x; m_i(r), O),    m_i(r) = sum_{n in i} w_n(r) x_n / g_i(r)

The K nearest training inputs are weighed by a Gaussian kernel w_n that is as wide as the nearer
ones are far, their targets are clustered, and every cluster is an expert: its mean regresses, as
kernel regression does, what the neighbours of one branch say, and the branches stay apart. A gate
is the share of the kernel in a cluster. O is the covariance of what a training target lacks of the
nearest mode of its own neighbours. Where a few global experts are too stiff for a map with many
folds, this follows it, at the price of keeping the training set.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.experts.conditional_density import Components, ConditionalDensity
from hmt_ros.experts.model_file import Arrays
from hmt_ros.experts.training_pairs import Standardisation, checked_pairs, checked_scaling

if TYPE_CHECKING:
    from typing_extensions import Self

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SWEEPS = 8
LEFT_OUT = 600  # training samples whose own modes tell how wrong modes are
RIDGE = 1e-6  # part of the targets' variance that is added to the covariance
BATCH = 256  # inputs whose neighbours are looked for together
FAINT = 1e-12  # weight of an expert that has no neighbour


class LocalExperts(ConditionalDensity):
    """Kernel regression in each mode of the neighbours' targets.

    The targets' own metric says which are alike: scale them before.

    Args:
        n_experts: M, modes of an input at most.
        n_neighbours: K, at most the number of samples less one.
        width_neighbour: the kernel is as wide as this neighbour is far.
        scaling: of inputs before distances are taken, 'each' column or one 'common' scale.
        seed: of the samples that are left out.

    Attributes:
        inputs_, targets_, sample_weight_: (N, p), (N, D), (N,) of the training set.
        noise_: (D, D) O.
        spacing_: root mean squared distance of a training input to its nearest one, scaled.
    """

    kind = 'local_experts'

    def __init__(
        self,
        n_experts: int = 5,
        n_neighbours: int = 40,
        width_neighbour: int = 8,
        scaling: str = 'common',
        seed: int = 0,
    ) -> None:
        self.n_experts = n_experts
        self.n_neighbours = n_neighbours
        self.width_neighbour = width_neighbour
        self.scaling = scaling
        self.seed = seed

    def fit(
        self, inputs: ArrayLike, targets: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Keeps the samples; see `ConditionalDensity.fit`."""
        checked_scaling(self.scaling)
        if not 1 <= self.width_neighbour <= self.n_neighbours or self.n_experts < 1:
            raise ValueError(
                f'n_experts {self.n_experts}, n_neighbours {self.n_neighbours}, width_neighbour '
                f'{self.width_neighbour}: wanted at least 1 of each, the width among the neighbours'
            )
        pairs = checked_pairs(
            inputs, targets, sample_weight,
            at_least=max(self.n_neighbours, self.n_experts) + 1, what='one more than neighbours',
        )  # fmt: skip
        self.n_inputs_, self.n_outputs_ = pairs.inputs.shape[1], pairs.targets.shape[1]
        scale = Standardisation.of(pairs.inputs, pairs.weights, self.scaling)
        self._keep(pairs.inputs, pairs.targets, pairs.weights, scale)
        offsets = pairs.targets - pairs.targets.mean(0)
        ridge = RIDGE * max(float((offsets**2).mean()), np.finfo(float).eps)
        self.noise_ = ridge * np.eye(self.n_outputs_)
        rng = np.random.default_rng(self.seed)
        left_out = np.sort(rng.permutation(len(pairs))[:LEFT_OUT])
        distances, index = self._nearest(self._scaled[left_out], self.n_neighbours + 1)
        self.spacing_ = max(float(np.sqrt((distances[:, 1] ** 2).mean())), np.finfo(float).tiny)
        weights, means = self._modes(distances[:, 1:], index[:, 1:])[:2]
        lack = pairs.targets[left_out][:, None] - means
        squared = np.where(weights > FAINT, (lack**2).sum(2), np.inf)
        nearest = lack[np.arange(len(lack)), squared.argmin(1)]
        share = pairs.weights[left_out] / pairs.weights[left_out].sum()
        self.noise_ = self.noise_ + (share * nearest.T) @ nearest
        return self

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p), heaviest expert first."""
        weights, means = self._modes(*self._neighbours(inputs))[:2]
        noise = np.broadcast_to(self.noise_, (self.n_experts, *self.noise_.shape))
        return Components(np.log(weights), means, np.ones_like(weights), noise)

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the means; neighbours, clusters and width as they are."""
        points = self._standardisation.apply(self._checked(inputs))
        distances, index = self._neighbours(inputs)
        _, means, shares, width = self._modes(distances, index)
        away = (self._scaled[index] - points[:, None]) / width[:, None, None] ** 2  # (n, K, p)
        lack = self.targets_[index][:, None] - means[:, :, None]  # (n, M, K, D)
        result: Array = np.einsum('nmk,nmkd,nkp->nmdp', shares, lack, away, optimize=True)
        return result / self._standardisation.scale

    def support(self, inputs: ArrayLike) -> Array:
        """exp(-(d / 3 s)^2 / 2), (n,): d to the nearest input, s the spacing of the samples."""
        points = self._standardisation.apply(self._checked(inputs))
        distances, _ = self._nearest(points, 1)
        result: Array = np.exp(-0.5 * (distances[:, 0] / (3.0 * self.spacing_)) ** 2)
        return result

    def _neighbours(self, inputs: ArrayLike) -> tuple[Array, Index]:
        points = self._standardisation.apply(self._checked(inputs))
        return self._nearest(points, self.n_neighbours)

    def _nearest(self, points: Array, count: int) -> tuple[Array, Index]:
        """Distances and rows (n, count) of the nearest samples, nearest first.

        In as many dimensions as descriptors have no tree is faster than looking at them all.
        """
        parts = [points[i : i + BATCH] for i in range(0, len(points), BATCH)]
        found = [self._nearest_of(x, count) for x in parts]
        return np.concatenate([x[0] for x in found]), np.concatenate([x[1] for x in found])

    def _nearest_of(self, points: Array, count: int) -> tuple[Array, Index]:
        squared = self._norms - 2.0 * points @ self._scaled.T
        index = np.argpartition(squared, count - 1, axis=1)[:, :count]
        squared = np.take_along_axis(squared, index, axis=1) + (points * points).sum(1)[:, None]
        order = np.argsort(squared, axis=1, kind='stable')
        distances = np.sqrt(np.maximum(np.take_along_axis(squared, order, axis=1), 0.0))
        return distances, np.take_along_axis(index, order, axis=1)

    def _modes(self, distances: Array, index: Index) -> tuple[Array, Array, Array, Array]:
        """Clusters of the neighbours (n, K) of n inputs.

        Returns:
            Weights (n, M) that sum to 1, heaviest first; means (n, M, D); shares (n, M, K) of the
            neighbours in the means; widths (n,) of the kernels.
        """
        n, count = distances.shape
        width = np.maximum(distances[:, self.width_neighbour - 1], 1e-9)
        kernel = np.exp(-0.5 * (distances / width[:, None]) ** 2) * self.sample_weight_[index]
        kernel = np.maximum(kernel / kernel.sum(1, keepdims=True), 1e-9)
        targets = self.targets_[index]
        squared = (targets * targets).sum(2)
        between = squared[:, :, None] + squared[:, None] - 2.0 * targets @ targets.swapaxes(1, 2)
        # From the nearest neighbour on, the one that weighs most and is furthest from those chosen.
        rows = np.arange(n)
        nearest = between[rows, 0]
        owner = np.zeros((n, count), dtype=np.intp)
        for m in range(1, min(self.n_experts, count)):
            chosen = (kernel * nearest).argmax(1)
            closer = between[rows, chosen] < nearest
            owner[closer] = m
            nearest = np.where(closer, between[rows, chosen], nearest)
        experts = np.arange(self.n_experts)[:, None]
        for _ in range(SWEEPS):
            member = (owner[:, None] == experts) * kernel[:, None]
            total = member.sum(2)
            means = (member @ targets) / np.maximum(total, 1e-300)[..., None]
            apart = (means * means).sum(2)[:, :, None] - 2.0 * means @ targets.swapaxes(1, 2)
            new = np.where(total[..., None] > 0, apart, np.inf).argmin(1)
            if (new == owner).all():
                break
            owner = new
        member = (owner[:, None] == experts) * kernel[:, None]
        total = member.sum(2)
        empty = total <= 0
        # An expert that nobody belongs to stands where the heaviest does, with no weight.
        heaviest = total.argmax(1)
        member = np.where(empty[..., None], member[rows, heaviest][:, None], member)
        shares = member / member.sum(2, keepdims=True)
        weights = np.where(empty, FAINT, total)
        order = np.argsort(-weights, axis=1, kind='stable')
        weights = np.take_along_axis(weights, order, axis=1)
        shares = np.take_along_axis(shares, order[..., None], axis=1)
        return weights / weights.sum(1, keepdims=True), shares @ targets, shares, width

    def _keep(self, inputs: Array, targets: Array, weights: Array, scale: Standardisation) -> None:
        self.inputs_, self.targets_, self.sample_weight_ = inputs, targets, weights
        self._standardisation = scale
        self._scaled = scale.apply(inputs)
        self._norms = (self._scaled * self._scaled).sum(1)

    def _learned(self) -> Arrays:
        return {
            # Half precision is far finer than the silhouettes of one pose differ.
            'inputs': self.inputs_.astype(np.float16),
            'targets': self.targets_.astype(np.float16),
            'sample_weight': self.sample_weight_.astype(np.float32),
            'centre': self._standardisation.centre,
            'scale': self._standardisation.scale,
            'noise': self.noise_,
            'spacing': np.array(self.spacing_),
        }

    def _set_learned(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        inputs, targets, weights = (
            np.asarray(arrays[name], dtype=np.float64)
            for name in ('inputs', 'targets', 'sample_weight')
        )
        if len(inputs) != len(targets) or weights.shape != inputs.shape[:1]:
            raise ValueError(f'inputs {inputs.shape} and targets {targets.shape} do not pair')
        scale = Standardisation(arrays['centre'], arrays['scale'])
        self._keep(inputs, targets, weights, scale)
        self.noise_ = np.asarray(arrays['noise'], dtype=np.float64)
        self.spacing_ = float(arrays['spacing'])
