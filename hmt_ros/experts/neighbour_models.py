"""Models that keep the training set and predict from the nearest neighbours of an input.

`NearestNeighbours` is the weighted nearest neighbour baseline of BME 3:

    p(x | r) = sum_k w_k N(x; x_k, O),    w_k proportional to 1 / |r - r_k|

over the K nearest training inputs. `LocalExperts` finds modes among the targets of the neighbours:

    p(x | r) = sum_i g_i(r) N(x; m_i(r), O),    m_i(r) = sum_{n in i} w_n(r) x_n / g_i(r)

The neighbours have the weights w_n of a Gaussian kernel. Their targets are clustered, and each
cluster is an expert. Its gate is the share of the kernel in the cluster; its mean is the kernel
regression over the cluster. Local experts fit maps with many folds better than a few global
experts, at the cost of storing the training set.

In both models, O is the covariance of the leave-one-out residuals of training targets.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from hmt_ros.body.learned_file import Arrays, check_positive, require
from hmt_ros.core import elementary
from hmt_ros.experts.conditional_density import Components, ConditionalDensity
from hmt_ros.experts.training_pairs import Standardisation, TrainingPairs, checked_pairs
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.clustering import smallest_columns
from hmt_ros.inference.linear_algebra import product

if TYPE_CHECKING:
    from typing_extensions import Self


BATCH_SIZE = 256  # number of inputs whose neighbours are searched together
RIDGE = 1e-6  # share of the targets' variance added to the covariance
# Minimum distance relative to the spacing, so that no single neighbour gets all the weight.
MIN_RELATIVE_DISTANCE = 1e-3
# Minimum spacing of samples, in scaled inputs, because samples may coincide.
MIN_SPACING = 1e-9
MAX_SWEEPS = 8  # maximum number of iterations of the clustering
LEFT_OUT_SAMPLES = 600  # number of training samples for the covariance of local experts
EMPTY_WEIGHT = 1e-12  # weight of an expert without neighbours
MAX_NEIGHBOURS = 1000  # maximum number of neighbours, and of experts, in a file


class _NeighbourModel(ConditionalDensity):
    """A training set with a search for nearest neighbours.

    Attributes:
        inputs_, targets_, sample_weight_: (N, p), (N, D), (N,) of the training set.
        noise_: (D, D) covariance O.
        spacing_: Typical distance of a training input to its neighbours, in scaled inputs.
    """

    n_neighbours: int
    scaling: str
    noise_: Array
    spacing_: float
    # Types of inputs and targets, and of weights, in files.
    _stored: tuple[DTypeLike, DTypeLike] = (np.float64, np.float64)

    def _keep_pairs(self, pairs: TrainingPairs) -> Array:
        """Store the samples and return the ridge (D, D) of their covariance."""
        self.n_inputs_, self.n_outputs_ = pairs.inputs.shape[1], pairs.targets.shape[1]
        self._keep(pairs, Standardisation.of(pairs.inputs, pairs.weights, self.scaling))
        offsets = pairs.targets - pairs.targets.mean(0)
        ridge = RIDGE * max(float((offsets**2).mean()), np.finfo(float).eps)
        return ridge * np.eye(self.n_outputs_)

    def _keep(self, pairs: TrainingPairs, standardisation: Standardisation) -> None:
        self.inputs_, self.targets_, self.sample_weight_ = (
            pairs.inputs,
            pairs.targets,
            pairs.weights,
        )
        self._standardisation = standardisation
        self._scaled = standardisation.apply(pairs.inputs)
        self._norms = (self._scaled * self._scaled).sum(1)

    def _neighbours(self, inputs: ArrayLike, count: int) -> tuple[Array, Index]:
        """Distances and rows (n, count) of the samples nearest to inputs (n, p), nearest first."""
        return self._nearest(self._standardisation.apply(self._checked(inputs)), count)

    def _nearest(self, points: Array, count: int) -> tuple[Array, Index]:
        """Distances and rows (n, count) of the samples nearest to standardised inputs (n, p).

        All distances are computed: in the high dimension of descriptors, no tree is faster.
        """
        distances, rows = np.empty((len(points), count)), np.empty((len(points), count), np.intp)
        for i in range(0, len(points), BATCH_SIZE):
            some = points[i : i + BATCH_SIZE]
            squared = self._norms - product(self._scaled, 2.0 * some.T).T
            index = smallest_columns(squared, count)
            squared = np.take_along_axis(squared, index, axis=1) + (some * some).sum(1)[:, None]
            order = np.argsort(squared, axis=1, kind='stable')
            squared = np.take_along_axis(squared, order, axis=1)
            distances[i : i + BATCH_SIZE] = np.sqrt(np.maximum(squared, 0.0))
            rows[i : i + BATCH_SIZE] = np.take_along_axis(index, order, axis=1)
        return distances, rows

    def _learned(self) -> Arrays:
        precision, of_weights = self._stored
        return {
            'inputs': self.inputs_.astype(precision),
            'targets': self.targets_.astype(precision),
            'sample_weight': self.sample_weight_.astype(of_weights),
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
        n, count = len(inputs), self.n_neighbours
        require(n == len(targets) == len(weights), 'samples do not pair')
        check_positive('weights and spacing', np.append(weights, arrays['spacing']))
        experts, nearest = (vars(self).get(x, 1) for x in ('n_experts', 'width_neighbour'))
        right = 1 <= nearest <= count <= min(n, MAX_NEIGHBOURS) and 1 <= experts <= MAX_NEIGHBOURS
        require(
            right, f'wanted 1 to {MAX_NEIGHBOURS} experts and neighbours, and no more than samples'
        )
        scale = Standardisation(arrays['centre'], arrays['scale'])
        self._keep(TrainingPairs(inputs, targets, weights), scale)
        self.noise_ = np.asarray(arrays['noise'], dtype=np.float64)
        self.spacing_ = float(arrays['spacing'])


class NearestNeighbours(_NeighbourModel):
    """The targets of the nearest inputs, weighted by inverse distance.

    Args:
        n_neighbours: Number of neighbours K, less than the number of samples.
        scaling: Scaling of inputs before distances are computed; see `Standardisation.of`.

    Attributes:
        spacing_: Root mean squared distance of an input to its K neighbours, in scaled inputs.
    """

    kind = 'nearest_neighbours'

    def __init__(self, n_neighbours: int = 5, scaling: str = 'each') -> None:
        self.n_neighbours = n_neighbours
        self.scaling = scaling

    def fit(
        self, inputs: ArrayLike, targets: ArrayLike, sample_weight: ArrayLike | None = None
    ) -> Self:
        """Store the samples; see `ConditionalDensity.fit`."""
        require(self.n_neighbours >= 1, f'n_neighbours is {self.n_neighbours}, wanted at least 1')
        pairs = checked_pairs(
            inputs,
            targets,
            sample_weight,
            at_least=self.n_neighbours + 1,
            what='one more than neighbours',
        )
        ridge = self._keep_pairs(pairs)
        distances, index = self._nearest(self._scaled, self.n_neighbours + 1)
        # A sample is its own neighbour, but not always the first neighbour if inputs are equal.
        own = index == np.arange(len(pairs))[:, None]
        own[~own.any(1), -1] = True
        shape = (len(pairs), self.n_neighbours)
        distances, index = distances[~own].reshape(shape), index[~own].reshape(shape)
        self.spacing_ = max(float(np.sqrt((distances**2).mean())), MIN_SPACING)
        residuals = pairs.targets[:, None] - pairs.targets[index]
        share = self._shares(distances, index) * (pairs.weights / pairs.weights.sum())[:, None]
        self.noise_ = ridge + np.einsum(
            'nk,nki,nkj->ij', share, residuals, residuals, optimize=True
        )
        return self

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p), nearest neighbour first."""
        distances, index = self._neighbours(inputs, self.n_neighbours)
        shares = self._shares(distances, index)
        noise = np.broadcast_to(self.noise_, (self.n_neighbours, *self.noise_.shape))
        return Components(elementary.log(shares), self.targets_[index], np.ones_like(shares), noise)

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Zeros (n, K, D, p): the neighbours' targets do not depend on the input."""
        points = self._checked(inputs)
        return np.zeros((len(points), self.n_neighbours, self.n_outputs_, self.n_inputs_))

    def support(self, inputs: ArrayLike) -> Array:
        """exp(-(d / s)^2 / 2), (n,): d is the distance to the nearest sample, s the spacing."""
        distances, _ = self._neighbours(inputs, 1)
        return np.asarray(elementary.exp(-0.5 * (distances[:, 0] / self.spacing_) ** 2))

    def _shares(self, distances: Array, index: Index) -> Array:
        closeness = 1.0 / np.maximum(distances, MIN_RELATIVE_DISTANCE * self.spacing_)
        closeness *= self.sample_weight_[index]
        return np.asarray(closeness / closeness.sum(1, keepdims=True))


class LocalExperts(_NeighbourModel):
    """Kernel regression in each mode of the neighbours' targets.

    Distances between targets are Euclidean, so callers scale the targets first.

    Args:
        n_experts: Maximum number of modes M at an input.
        n_neighbours: Number of neighbours K, less than the number of samples.
        width_neighbour: Rank of the neighbour whose distance is the kernel width.

    Attributes:
        spacing_: Root mean squared distance of an input to its nearest neighbour, in scaled inputs.
    """

    kind = 'local_experts'
    # Half precision is far finer than the differences between silhouettes of one pose.
    _stored = (np.float16, np.float32)

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
        """Store the samples; see `ConditionalDensity.fit`."""
        require(
            1 <= self.width_neighbour <= self.n_neighbours and self.n_experts >= 1,
            f'n_experts {self.n_experts}, n_neighbours {self.n_neighbours}, width_neighbour '
            f'{self.width_neighbour}: wanted at least 1 of each, the width among the neighbours',
        )
        pairs = checked_pairs(
            inputs,
            targets,
            sample_weight,
            at_least=max(self.n_neighbours, self.n_experts) + 1,
            what='one more than neighbours',
        )
        ridge = self._keep_pairs(pairs)
        rng = np.random.default_rng(self.seed)
        left_out = np.sort(rng.permutation(len(pairs))[:LEFT_OUT_SAMPLES])
        distances, index = self._nearest(self._scaled[left_out], self.n_neighbours + 1)
        self.spacing_ = max(float(np.sqrt((distances[:, 1] ** 2).mean())), MIN_SPACING)
        weights, means = self._modes(distances[:, 1:], index[:, 1:])[:2]
        residuals = pairs.targets[left_out][:, None] - means
        squared = np.where(weights > EMPTY_WEIGHT, (residuals**2).sum(2), np.inf)
        nearest = residuals[np.arange(len(residuals)), squared.argmin(1)]
        share = pairs.weights[left_out] / pairs.weights[left_out].sum()
        self.noise_ = ridge + product(share * nearest.T, nearest)
        return self

    def components(self, inputs: ArrayLike) -> Components:
        """The mixtures at inputs (n, p), heaviest expert first."""
        weights, means = self._modes(*self._neighbours(inputs, self.n_neighbours))[:2]
        noise = np.broadcast_to(self.noise_, (self.n_experts, *self.noise_.shape))
        return Components(elementary.log(weights), means, np.ones_like(weights), noise)

    def jacobians(self, inputs: ArrayLike) -> Array:
        """Derivatives (n, M, D, p) of the means, with neighbours, clusters and width held fixed."""
        points = self._standardisation.apply(self._checked(inputs))
        distances, index = self._nearest(points, self.n_neighbours)
        _, means, shares, width = self._modes(distances, index)
        away = (self._scaled[index] - points[:, None]) / width[:, None, None] ** 2  # (n, K, p)
        residuals = self.targets_[index][:, None] - means[:, :, None]  # (n, M, K, D)
        result: Array = product((shares[..., None] * residuals).swapaxes(2, 3), away[:, None])
        return result / self._standardisation.scale

    def support(self, inputs: ArrayLike) -> Array:
        """exp(-(d / 3 s)^2 / 2), (n,): d is the distance to the nearest sample, s the spacing."""
        distances, _ = self._neighbours(inputs, 1)
        return np.asarray(elementary.exp(-0.5 * (distances[:, 0] / (3.0 * self.spacing_)) ** 2))

    def _modes(self, distances: Array, index: Index) -> tuple[Array, Array, Array, Array]:
        """Cluster the neighbours (n, K) of n inputs.

        Runs k-means weighted by the kernel, for all inputs at once; scipy's k-means has no weights.

        Returns:
            Weights (n, M) that sum to 1, heaviest first; means (n, M, D); shares (n, M, K) of the
            neighbours in each mean; widths (n,) of the kernels.
        """
        n, count = distances.shape
        width = np.maximum(distances[:, self.width_neighbour - 1], 1e-9)
        kernel = (
            elementary.exp(-0.5 * (distances / width[:, None]) ** 2) * self.sample_weight_[index]
        )
        kernel = np.maximum(kernel / kernel.sum(1, keepdims=True), 1e-9)
        targets = self.targets_[index]
        squared = (targets * targets).sum(2)
        between = (
            squared[:, :, None] + squared[:, None] - product(2.0 * targets, targets.swapaxes(1, 2))
        )
        # Seeds: the nearest neighbour, then repeatedly the neighbour with the largest weight times
        # squared distance to the seeds.
        rows = np.arange(n)
        nearest = between[rows, 0]
        owner = np.zeros((n, count), dtype=np.intp)
        for m in range(1, min(self.n_experts, count)):
            chosen = (kernel * nearest).argmax(1)
            closer = between[rows, chosen] < nearest
            owner[closer] = m
            nearest = np.where(closer, between[rows, chosen], nearest)
        experts = np.arange(self.n_experts)[:, None]
        for _ in range(MAX_SWEEPS):
            member = (owner[:, None] == experts) * kernel[:, None]
            total = member.sum(2)
            means = product(member, targets) / np.maximum(total, 1e-300)[..., None]
            apart = (means * means).sum(2)[:, :, None] - product(
                2.0 * means, targets.swapaxes(1, 2)
            )
            new = np.where(total[..., None] > 0, apart, np.inf).argmin(1)
            if (new == owner).all():
                break
            owner = new
        member = (owner[:, None] == experts) * kernel[:, None]
        total = member.sum(2)
        empty = total <= 0
        # An expert without members gets the mean of the heaviest expert and no weight.
        heaviest = total.argmax(1)
        member = np.where(empty[..., None], member[rows, heaviest][:, None], member)
        shares = member / member.sum(2, keepdims=True)
        weights = np.where(empty, EMPTY_WEIGHT, total)
        order = np.argsort(-weights, axis=1, kind='stable')
        weights = np.take_along_axis(weights, order, axis=1)
        shares = np.take_along_axis(shares, order[..., None], axis=1)
        return weights / weights.sum(1, keepdims=True), product(shares, targets), shares, width
