"""Learning of a pose predictor, and what a training set says of how ambiguous silhouettes are.

The reports are those of BME: affinity matrices of poses and of descriptors (fig. 7), and the number
of clusters of poses that fall under one cluster of descriptors (fig. 6).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body
from hmt_ros.experts.calibrated_experts import CalibratedExperts
from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.experts.descriptor.shape_context import cluster_centres, squared_distances
from hmt_ros.experts.descriptor.silhouette_descriptor import (
    SilhouetteDescriptor,
    SilhouetteParts,
    silhouette_parts,
)
from hmt_ros.experts.pose_encoding import PoseEncoding
from hmt_ros.experts.pose_predictor import PosePredictor
from hmt_ros.experts.training_pairs import finite_matrix
from hmt_ros.experts.training_set import TrainingSet

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Bytes = NDArray[np.uint8]
Progress = Callable[[Iterable[Bytes], int], Iterable[Bytes]]

FOR_DESCRIPTOR = 3000  # silhouettes that the descriptor learns from at most
FOR_BASIS = 600  # poses that the metric of targets is averaged over at most
AWAY = 5.0  # m, depth of the poses in that average
SMALLEST = 3e-3  # m per radian, of a number that moves no joint: it counts a little all the same
# Added to the previous states that dynamics learns from, in their standard deviations: what comes
# before is an estimate, not the truth.
STATE_NOISE = 0.5


@dataclass(frozen=True, eq=False)
class Described:
    """A training set as numbers.

    Attributes:
        descriptor: that has learned.
        parts: (N,) views of the silhouettes.
        descriptors: (N, p).
        targets, previous: (N, D) encoded poses, and those one step before.
        motions: (N,) the number of the motion that a sample is of.
    """

    descriptor: SilhouetteDescriptor
    parts: list[SilhouetteParts]
    descriptors: Array
    targets: Array
    previous: Array
    motions: Index

    def with_components(self, count: int) -> Described:
        """The same with the first components of the descriptor alone, `count` at most.

        Full covariances of inputs want fewer of them than distances to neighbours.
        """
        count = min(count, self.descriptor.size)
        return replace(
            self,
            descriptor=self.descriptor.with_components(count),
            descriptors=self.descriptors[:, :count],
        )


def described(
    body: Body,
    pairs: TrainingSet,
    descriptor: SilhouetteDescriptor | None = None,
    progress: Progress | None = None,
) -> Described:
    """Descriptors and targets of a training set.

    Args:
        body: of the poses.
        pairs: silhouettes and poses.
        descriptor: that is to learn; None: the usual one.
        progress: goes through the silhouettes, and is told how many there are.
    """
    descriptor = descriptor or SilhouetteDescriptor()
    masks: Iterable[Bytes] = pairs.masks()
    if progress is not None:
        masks = progress(masks, len(pairs))
    parts = [silhouette_parts(mask, descriptor.points) for mask in masks]
    some = np.random.default_rng(descriptor.seed).permutation(len(parts))[:FOR_DESCRIPTOR]
    descriptor.fit_parts([parts[i] for i in np.sort(some)])
    encoding = PoseEncoding(body)
    return Described(
        descriptor, parts, descriptor.describe_parts(parts), encoding.encode(pairs.poses),
        encoding.encode(pairs.previous), pairs.sequences,
    )  # fmt: skip


def learned_predictor(
    body: Body,
    training: Described,
    model: ConditionalDensity,
    dynamics: ConditionalDensity | None = None,
    notes: dict[str, Any] | None = None,
    seed: int = 0,
) -> PosePredictor:
    """A predictor that has learned from a training set.

    Args:
        body: of the poses.
        training: described.
        model: that is to learn p(z | descriptor).
        dynamics: that is to learn p(z | previous z, descriptor), or None.
        notes: kept in the file.
        seed: of the noise of previous states.

    Raises:
        ValueError: too few samples, or some that are not finite.
    """
    for name in ('descriptors', 'targets', 'previous'):
        finite_matrix(getattr(training, name), name, '(N, ...)')
    basis = target_basis(PoseEncoding(body), training.targets)
    # As much variance in states as in descriptors: dynamics measures distances over both.
    spread = float((training.targets @ basis).var(0).sum())
    basis = basis * np.sqrt(training.descriptors.var(0).sum() / max(spread, 1e-12))
    states = training.targets @ basis
    _learn(model, training.descriptors, states, training.motions)
    if dynamics is not None:
        before = training.previous @ basis
        noise = np.random.default_rng(seed).normal(size=before.shape)
        before = before + STATE_NOISE * before.std(0) * noise
        inputs = np.hstack([before, training.descriptors])
        _learn(dynamics, inputs, states, training.motions)
    return PosePredictor(body, training.descriptor, model, basis, dynamics, notes)


def _learn(model: ConditionalDensity, inputs: Array, targets: Array, motions: Index) -> None:
    if isinstance(model, CalibratedExperts):
        # Of a single motion stretches of time are left out.
        several = len(np.unique(motions)) > 1
        model.fit(inputs, targets, groups=motions if several else None)
    else:
        model.fit(inputs, targets)


def target_basis(encoding: PoseEncoding, targets: Array) -> Array:
    """(D, D) B with |B' dx| the distance that the joints move for a change dx of a target, m.

    Root mean square over joints other than the pelvis, on average over the targets (N, D). A change
    of a wrist then counts less than one of a hip.
    """
    chosen = targets[:: max(len(targets) // FOR_BASIS, 1)][:FOR_BASIS]
    roots = np.tile([[0.0, 0.0, AWAY]], (len(chosen), 1))
    body = encoding.body
    by_target, _ = encoding.jacobians(chosen, roots)
    slopes = body.joint_jacobians(encoding.decode(chosen, roots))
    slopes = slopes - slopes[:, body.skeleton.joint_index(('pelvis',))]
    slopes = slopes.reshape(len(chosen), -1, body.dimension) @ by_target
    metric = np.einsum('nij,nik->jk', slopes, slopes, optimize=True)
    metric /= len(chosen) * (len(body.joint_names) - 1)
    factor: Array = np.linalg.cholesky(metric + SMALLEST**2 * np.eye(encoding.size))
    return factor


def affinities(vectors: Array) -> Array:
    """Affinities (n, n) of vectors (n, q): exp(-d^2 / 2 s^2), s the median distance."""
    squared = squared_distances(vectors, vectors)
    off = squared[~np.eye(len(squared), dtype=bool)]
    scale = max(float(np.median(off)) if len(off) else 1.0, 1e-12)
    result: Array = np.exp(-0.5 * squared / scale)
    return result


def multimodality(inputs: Array, targets: Array, clusters: int, seed: int = 0) -> Index:
    """How many clusters of targets fall under each cluster of inputs (BME fig. 6).

    Args:
        inputs: (N, p), clustered for themselves.
        targets: (N, D), clustered for themselves.
        clusters: of either.
        seed: of the clustering.

    Returns:
        (H,) number of clusters of inputs under which 1, 2, ... H clusters of targets fall.

    Raises:
        ValueError: more clusters than samples.
    """
    if not 1 <= clusters <= len(inputs):
        raise ValueError(f'{clusters} clusters of {len(inputs)} samples')
    labels = [
        squared_distances(x, cluster_centres(x, clusters, seed, sweeps=5)).argmin(1)
        for x in (inputs, targets)
    ]
    pairs = np.unique(np.stack(labels, axis=1), axis=0)
    under = np.bincount(pairs[:, 0], minlength=clusters)
    counts: Index = np.bincount(under[under > 0])[1:]
    return counts
