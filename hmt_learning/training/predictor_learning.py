"""Training of a pose predictor: its models by name, learning, and reports on ambiguity.

The reports are those of BME 3: affinity matrices of poses and of descriptors (fig. 7), and the
number of clusters of poses under one cluster of descriptors (fig. 6).

The numbers of experts and of components of the descriptor, and the stiffness of the experts, were
chosen on motions of other people, so numbers on those motions are optimistic.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hmt_learning.training.calibration_learning import LearningCalibration
from hmt_learning.training.descriptor_learning import learned_descriptor
from hmt_learning.training.network_learning import LearningNetwork, tools_are_there
from hmt_learning.training.training_set import TrainingSet
from hmt_ros.body import Body
from hmt_ros.experts.conditional_density import ConditionalDensity
from hmt_ros.experts.descriptor.silhouette_descriptor import SilhouetteDescriptor
from hmt_ros.experts.expert_mixture import (
    ConditionalExperts,
    JointExperts,
)
from hmt_ros.experts.neighbour_models import LocalExperts, NearestNeighbours
from hmt_ros.experts.pose_encoding import PoseEncoding
from hmt_ros.experts.pose_predictor import ADDED_VARIANCE, PosePredictor
from hmt_ros.experts.training_pairs import finite_matrix
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.clustering import k_means, squared_distances

Progress = Callable[[Iterable[int], int], Iterable[int]]

SAMPLES_PER_EXPERT = 40  # minimum for a linear expert of the joint model
NEIGHBOURS = 40  # number of neighbours of the local model
WIDTH = 3.0  # kernel width of the conditional model's gates, in standard deviations of an input

FOR_DESCRIPTOR = 3000  # maximum number of silhouettes from which the descriptor is learned
FOR_BASIS = 600  # maximum number of poses for the average metric of targets
AWAY = 5.0  # depth of the poses in that average, m
MIN_METRIC = 3e-3  # metric of a component that moves no joint, m per radian
# Noise added to previous states when dynamics are learned, because a previous state is an estimate:
# standard deviation relative to that of the states.
STATE_NOISE = 0.5


@dataclass(frozen=True)
class ModelKind:
    """Constructor and default sizes of a kind of model.

    Attributes:
        make: Makes the model from a number of experts, a seed and, if known, the number of samples.
            The baselines use the first as the number of neighbours, or ignore it.
        experts: Default number of experts M.
        components: Number of components of the descriptor that are inputs of the model.
        dynamics_experts: Number of experts of p(x_t | x_t-1, r_t); None selects M.
        few: Whether the number of experts is limited by the number of samples.
        folds: Number of parts of the motions for calibration; fewer for slow models.
    """

    make: Callable[[int, int, int | None], ConditionalDensity]
    experts: int
    components: int = 64
    dynamics_experts: int | None = None
    few: bool = False
    folds: int = 3


def _local(experts: int, seed: int, samples: int | None) -> ConditionalDensity:
    # Calibration leaves out a third of the samples; neighbours are among the others.
    neighbours = NEIGHBOURS if samples is None else max(min(NEIGHBOURS, samples // 3), 8)
    return LocalExperts(experts, neighbours, seed=seed)


def _conditional(experts: int, seed: int, _: int | None) -> ConditionalDensity:
    return ConditionalExperts(
        experts,
        'linear',
        scaling='common',
        seed=seed,
        width=WIDTH,
        n_starts=1,
        max_iterations=5,
        max_kernels=200,
    )


def _joint(experts: int, seed: int, _: int | None) -> ConditionalDensity:
    return JointExperts(
        experts, 'linear', scaling='common', seed=seed, n_starts=1, max_iterations=12
    )


def _network(experts: int, seed: int, _: int | None) -> ConditionalDensity:
    return LearningNetwork(experts, seed=seed)


KINDS = {
    'network': ModelKind(_network, 5, 96, folds=2),
    'local': ModelKind(_local, 5),
    'conditional': ModelKind(_conditional, 8, 40, 6, few=True, folds=2),
    'joint': ModelKind(_joint, 30, 40, few=True, folds=2),
    'relevance-vector': ModelKind(
        lambda _, seed, __: ConditionalExperts(1, scaling='common', seed=seed, n_starts=1), 1
    ),
    'nearest': ModelKind(lambda experts, _, __: NearestNeighbours(experts, scaling='common'), 5),
}


def kinds() -> tuple[str, ...]:
    """Names of the models that can learn here; the network needs JAX and Optax."""
    return tuple(name for name in KINDS if name != 'network' or tools_are_there())


def new_model(
    name: str, experts: int | None = None, seed: int = 0, samples: int | None = None
) -> ConditionalDensity:
    """A calibrated model before learning.

    Args:
        experts: Number of experts M; None selects the default. Fewer for few samples.

    Raises:
        ValueError: the name of the model is unknown.
    """
    if name not in KINDS:
        raise ValueError(f'no model {name!r}, wanted one of {", ".join(sorted(KINDS))}')
    kind = KINDS[name]
    count = kind.experts if experts is None else experts
    if kind.few and samples is not None:
        count = max(min(count, samples // SAMPLES_PER_EXPERT), 1)
    return LearningCalibration(kind.make(count, seed, samples), kind.folds)


@dataclass(frozen=True, eq=False)
class Described:
    """Descriptors and targets of a training set.

    Attributes:
        descriptors: (N, p) descriptors of the silhouettes.
        targets, previous: (N, D) encoded poses, and those one step earlier.
        motions: (N,) index of the motion of each sample.
    """

    descriptor: SilhouetteDescriptor
    descriptors: Array
    targets: Array
    previous: Array
    motions: Index

    def with_components(self, count: int) -> Described:
        """The training set with at most `count` components of the descriptor.

        Models with full input covariances need fewer components than nearest neighbours.
        """
        count = min(count, self.descriptor.size)
        return replace(
            self,
            descriptor=replace(self.descriptor, basis=self.descriptor.basis[:, :count]),
            descriptors=self.descriptors[:, :count],
        )


def described(
    body: Body,
    pairs: TrainingSet,
    progress: Progress | None = None,
    **of_descriptor: int,
) -> Described:
    """Descriptors and targets of a training set.

    Args:
        progress: Shows the progress of an iteration, given an iterable and its length.
        of_descriptor: Keyword arguments of `learned_descriptor`.
    """
    # Shape contexts of all silhouettes would fill the memory.
    some = np.sort(np.random.default_rng(0).permutation(len(pairs))[:FOR_DESCRIPTOR])
    descriptor = learned_descriptor([pairs.parts(i) for i in some.tolist()], **of_descriptor)
    samples: Iterable[int] = range(len(pairs))
    if progress is not None:
        samples = progress(samples, len(pairs))
    rows = [descriptor.describe([pairs.parts(i, descriptor.points)])[0] for i in samples]
    encoding = PoseEncoding(body)
    return Described(
        descriptor,
        np.array(rows),
        encoding.encode(pairs.poses),
        encoding.encode(pairs.previous),
        pairs.sequences,
    )


def learned_predictor(
    body: Body,
    training: Described,
    model: ConditionalDensity,
    dynamics: ConditionalDensity | None = None,
    notes: dict[str, Any] | None = None,
    seed: int = 0,
) -> PosePredictor:
    """Trains a predictor on a training set.

    Args:
        model: Model that learns p(z | descriptor).
        dynamics: Model that learns p(z | previous z, descriptor), or None.

    Raises:
        ValueError: there are too few samples, or some are not finite.
    """
    for name in ('descriptors', 'targets', 'previous'):
        finite_matrix(getattr(training, name), name, '(N, ...)')
    basis = target_basis(PoseEncoding(body), training.targets)
    # States and descriptors get the same variance, because dynamics measure distances over both.
    width = float((training.targets @ basis).var(0).sum())
    basis = basis * np.sqrt(training.descriptors.var(0).sum() / max(width, 1e-12))
    states = training.targets @ basis
    _learn(model, training.descriptors, states, training.motions)
    if dynamics is not None:
        before = training.previous @ basis
        noise = np.random.default_rng(seed).normal(size=before.shape)
        before = before + STATE_NOISE * before.std(0) * noise
        inputs = np.hstack([before, training.descriptors])
        _learn(dynamics, inputs, states, training.motions)
    mean, spread = training.targets.mean(0), np.cov(training.targets.T)
    equilibrium = GaussianMixture(
        np.ones(1), mean[None], (spread + ADDED_VARIANCE * np.eye(len(mean)))[None]
    )
    return PosePredictor(body, training.descriptor, model, basis, equilibrium, dynamics, notes)


def _learn(model: ConditionalDensity, inputs: Array, targets: Array, motions: Index) -> None:
    if isinstance(model, LearningCalibration):
        # With a single motion, intervals of time are left out.
        several = len(np.unique(motions)) > 1
        model.fit(inputs, targets, groups=motions if several else None)
    else:
        model.fit(inputs, targets)


def target_basis(encoding: PoseEncoding, targets: Array) -> Array:
    """Basis B (D, D) such that |B' dx| is the motion of the joints for a target change dx, m.

    It is the root mean square over all joints but the pelvis, averaged over the targets (N, D), so
    that a change of a wrist counts less than that of a hip.
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
    return np.linalg.cholesky(metric + MIN_METRIC**2 * np.eye(encoding.size))


def affinities(vectors: Array) -> Array:
    """Affinities (n, n) of vectors (n, q): exp(-d^2 / 2 s^2), s the median d (BME fig. 7)."""
    squared = squared_distances(vectors, vectors)
    off = squared[~np.eye(len(squared), dtype=bool)]
    scale = max(float(np.median(off)) if len(off) else 1.0, 1e-12)
    return np.exp(-0.5 * squared / scale)


def multimodality(inputs: Array, targets: Array, clusters: int, seed: int = 0) -> Index:
    """The number of clusters of targets under each cluster of inputs (BME fig. 6).

    Args:
        inputs, targets: (N, p) and (N, D) samples, which are clustered independently.
        clusters: Number of clusters of inputs, and of targets.

    Returns:
        (H,) number of clusters of inputs with 1, 2, ... H clusters of targets.

    Raises:
        ValueError: there are more clusters than samples.
    """
    if not 1 <= clusters <= len(inputs):
        raise ValueError(f'{clusters} clusters of {len(inputs)} samples')
    labels = [
        k_means(x, clusters, np.random.default_rng(seed), iterations=5)[1]
        for x in (inputs, targets)
    ]
    pairs = np.unique(np.stack(labels, axis=1), axis=0)
    under = np.bincount(pairs[:, 0], minlength=clusters)
    return np.bincount(under[under > 0])[1:]
