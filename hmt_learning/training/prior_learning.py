"""Learns the prior of the poses of a body from motions (`hmt_ros.body.pose_prior`).

Motions become poses of the body, and poses that are nearly equal are dropped. The number of poses
of a motion is limited, and the weight of a person is the square root of the number of poses.
Every pose is used with its mirror image, too. The number of components maximises the likelihood of
people who are left out, as a mean over people.

Expectation maximisation of Gaussian mixtures over angles and their mirror images.

    p(a) = w_0 N(a; m_0, S_0) + (1 - w_0) sum_k w_k/2 [N(a; m_k, S_k) + N(Ra; m_k, S_k)]

A sample a and its mirror image Ra have the same density, so K components stand for 2 K. Component 0
is fixed. The covariances have an inverse Wishart prior of v samples with the scatter B; every
iteration increases

    F = sum_n s_n log p(a_n) - v/2 sum_k [log |S_k| + tr(B S_k^-1)]
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import logsumexp

from hmt_learning.training.training_set import PoseSequence, novel_frames
from hmt_ros.body import Body
from hmt_ros.body.angle_mixture import AngleMixture
from hmt_ros.body.mirror import mirror
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.mixture import GaussianMixture

# Minimum standard deviation within a motion of an angle that was recorded, rad.
STILL = np.radians(0.5)

Progress = Callable[[Iterable[int], int], Iterable[int]]
# A component with less than this share of one sample keeps its mean and covariance.
MIN_SAMPLES = 1e-3


@dataclass(frozen=True, eq=False)
class MirroredSamples:
    """Samples with their mirror images.

    Attributes:
        angles, images: (N, n) samples and their mirror images, rad.
        weights: (N,) effective number of independent samples of each.
    """

    angles: Array
    images: Array
    weights: Array

    @property
    def both(self) -> Array:
        """Samples, then their mirror images, (2 N, n)."""
        return np.concatenate([self.angles, self.images])

    def scatter(self) -> tuple[Array, Array]:
        """Mean (n,) and covariance (n, n) of samples and mirror images together."""
        points, weights = self.both, np.tile(self.weights, 2) / (2.0 * self.weights.sum())
        mean = weights @ points
        offset = points - mean
        return mean, (offset * weights[:, None]).T @ offset


@dataclass(frozen=True, eq=False)
class CovariancePrior:
    """The inverse Wishart prior of the covariances.

    Attributes:
        samples: v, the number of samples that the prior is worth.
        scatter: (n, n) B, rad^2.
    """

    samples: float
    scatter: Array

    def log_density(self, covariances: Array) -> float:
        """Log density of covariances (K, n, n), up to a constant."""
        trace = np.trace(np.linalg.solve(covariances, self.scatter), axis1=1, axis2=2)
        return float(-0.5 * self.samples * (np.linalg.slogdet(covariances)[1] + trace).sum())


def mirrored_log_densities(mixture: GaussianMixture, angles: Array, images: Array) -> Array:
    """Log terms (N, 2 K + 1) of p: components at the angles, at the images, and the broad one.

    Args:
        mixture: component 0, then K components.
        angles, images: (N, n) samples and their mirror images, rad.
    """
    with np.errstate(divide='ignore'):
        log_weights = np.log(mixture.weights)
    halves = log_weights[1:] - np.log(2.0)
    own = mixture[1:]
    return np.concatenate(
        [
            own.component_log_densities(angles) + halves,
            own.component_log_densities(images) + halves,
            mixture[:1].component_log_densities(angles) + log_weights[:1],
        ],
        axis=1,
    )


def seeds_of(samples: MirroredSamples, count: int, rng: np.random.Generator) -> Array:
    """Samples (K, n) far from each other, drawn as in k-means++."""
    scale = np.sqrt(np.maximum(np.diagonal(samples.scatter()[1]), 1e-12))
    chosen: list[Array] = []
    nearest = np.ones(len(samples.angles))
    for _ in range(count):
        weights = samples.weights * nearest
        total = weights.sum()
        share = weights / total if total > 0 else samples.weights / samples.weights.sum()
        chosen.append(samples.angles[rng.choice(len(share), p=share)])
        away = [(((x - chosen[-1]) / scale) ** 2).sum(1) for x in (samples.angles, samples.images)]
        away = np.minimum(*away)
        nearest = away if len(chosen) == 1 else np.minimum(nearest, away)
    return np.array(chosen)


def fitted_mixture(
    samples: MirroredSamples,
    start: GaussianMixture,
    prior: CovariancePrior,
    iterations: int = 100,
    tolerance: float = 1e-3,
) -> tuple[GaussianMixture, list[float]]:
    """Fits a mixture by expectation maximisation.

    Args:
        start: component 0, which stays fixed, then K components; weights sum to 1.
        tolerance: minimum increase of F in an iteration, nats per sample; EM ends below it.

    Returns:
        The mixture, and F before each iteration.
    """
    points, k = samples.both, len(start) - 1
    broad, mixture = start[:1], start
    bounds: list[float] = []
    for _ in range(iterations):
        log = mirrored_log_densities(mixture, samples.angles, samples.images)
        total = logsumexp(log, axis=1)
        bound = samples.weights @ total + prior.log_density(mixture.covariances[1:])
        if bounds and bound - bounds[-1] < tolerance * samples.weights.sum():
            return mixture, [*bounds, float(bound)]
        bounds.append(float(bound))
        shares = np.exp(log - total[:, None]) * samples.weights[:, None]
        each = np.concatenate([shares[:, :k], shares[:, k : 2 * k]])
        filled = each.sum(0)
        means, covariances = mixture.means[1:].copy(), mixture.covariances[1:].copy()
        for i in np.flatnonzero(filled > MIN_SAMPLES):
            means[i] = each[:, i] @ points / filled[i]
            offset = points - means[i]
            scatter = (offset * each[:, i : i + 1]).T @ offset
            covariances[i] = (scatter + prior.samples * prior.scatter) / (filled[i] + prior.samples)
        weights = (1.0 - broad.weights[0]) * filled / filled.sum()
        mixture = GaussianMixture(
            np.concatenate([broad.weights, weights]),
            np.concatenate([broad.means, means]),
            np.concatenate([broad.covariances, covariances]),
        )
    return mixture, bounds


@dataclass(frozen=True)
class PriorSettings:
    """Settings of the learning.

    Attributes:
        components: Candidate numbers of components; mirror images do not count.
        folds: Number of groups of people for cross-validation.
        novelty: Minimum mean joint distance of a pose from the last kept pose of its motion, m;
            closer poses are dropped.
        most_poses: Maximum number of poses of a motion.
        shrinkage: Weight of the covariance of all poses in that of a component, number of poses.
        compactness: Factor on the covariance of all poses in this use.
        bandwidth: Standard deviation added to each component for other people and measurements,
            relative to the standard deviation of an angle over all poses.
        broad_weight: Weight of the broad component, the Gaussians of the body's model file. The
            energy of a pose exceeds that under these Gaussians by log(1 / weight) nats at most.
        iterations: Maximum number of iterations of EM.
        seed: Seed of the initial means.
    """

    components: tuple[int, ...] = (2, 4, 8, 12, 16)
    folds: int = 5
    novelty: float = 0.03
    most_poses: int = 40
    shrinkage: float = 200.0
    compactness: float = 0.5
    bandwidth: float = 0.2
    broad_weight: float = 0.4
    iterations: int = 60
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.components or min(self.components) < 1:
            raise ValueError(f'components must be numbers from 1, saw {self.components}')
        if self.folds < 2:
            raise ValueError(f'folds must be at least 2, saw {self.folds}')
        if not 0.0 < self.broad_weight < 1.0:
            raise ValueError(f'broad_weight must lie between 0 and 1, saw {self.broad_weight}')


@dataclass(frozen=True, eq=False)
class LearnedPrior:
    """A prior and its scores.

    Attributes:
        mixture: the prior.
        held_out: number of components -> log likelihood of people left out, nats per pose.
        plain: log likelihood of the Gaussians of the body's model file, nats per pose.
        poses, motions, people: numbers of poses, motions and people in the training data.
    """

    mixture: AngleMixture
    held_out: Mapping[int, float]
    plain: float
    poses: int
    motions: int
    people: int


@dataclass(frozen=True, eq=False)
class PriorData:
    """Poses to learn from, motion by motion.

    Attributes:
        body: body of the poses.
        poses: poses (T, d) of each motion.
        people: name of the person of each motion.
    """

    body: Body
    poses: tuple[Array, ...]
    people: tuple[str, ...]

    def of(self, people: Iterable[str]) -> PriorData:
        """The motions of some people."""
        wanted = set(people)
        chosen = [i for i, person in enumerate(self.people) if person in wanted]
        return PriorData(
            self.body,
            tuple(self.poses[i] for i in chosen),
            tuple(self.people[i] for i in chosen),
        )

    def samples(self, dofs: Index) -> MirroredSamples:
        """The poses as samples of some angles; a person's weight is the root of the pose count.

        Args:
            dofs: (n,) degrees of freedom.
        """
        poses = np.concatenate(self.poses)
        owner = np.repeat(self.people, [len(x) for x in self.poses])
        _, place, counts = np.unique(owner, return_inverse=True, return_counts=True)
        weights = np.asarray(counts[place] ** -0.5, dtype=np.float64)
        weights *= len(poses) / weights.sum()
        return MirroredSamples(poses[:, dofs], mirror(self.body, poses)[:, dofs], weights)

    def score(self, log_density: Callable[[Array], Array]) -> float:
        """Mean over the people of the mean of a log density over their poses.

        Args:
            log_density: log density (N,) as a function of poses (N, d).
        """
        own = [np.concatenate(self.of([x]).poses) for x in sorted(set(self.people))]
        return float(np.mean([log_density(poses).mean() for poses in own]))


def prior_data(
    body: Body, sequences: Sequence[PoseSequence], people: Sequence[str], settings: PriorSettings
) -> PriorData:
    """Poses of motions without near duplicates, at most `most_poses` of each."""
    kept = []
    for sequence in sequences:
        frames = novel_frames(body, sequence.poses, settings.novelty)
        if len(frames) > settings.most_poses:
            every = np.linspace(0, len(frames) - 1, settings.most_poses)
            frames = frames[every.round().astype(np.intp)]
        kept.append(sequence.poses[frames])
    return PriorData(body, tuple(kept), tuple(people))


def recorded_dofs(body: Body, sequences: Sequence[PoseSequence], people: Sequence[str]) -> Index:
    """Indices (n,) of the recorded angles: those that move in more than half of the people.

    Root angles are excluded: the person's heading and the camera's tilt are not posture.
    """
    moves = {
        person: np.median(
            [x.poses.std(0) for x, own in zip(sequences, people, strict=True) if own == person],
            axis=0,
        )
        for person in set(people)
    }
    share = np.mean([x > STILL for x in moves.values()], axis=0)
    # Angles of the left and the right side are covered together or not.
    share = np.minimum(share, np.abs(mirror(body, share[None])[0]))
    skeleton = body.skeleton
    inner = skeleton.dof_is_rotation & (skeleton.dof_segments > 0)
    return np.flatnonzero(inner & (share > 0.5))


def learned_prior(
    data: PriorData,
    dofs: Index,
    card: Mapping[str, Any],
    settings: PriorSettings,
    progress: Progress | None = None,
) -> LearnedPrior:
    """Learns a prior.

    Args:
        dofs: (n,) angles that the prior covers.
        card: description of the data, text by heading.
        progress: shows the progress of an iteration, given an iterable and its length.

    Raises:
        ValueError: fewer people than groups, or no angles.
    """
    s, people = settings, sorted(set(data.people))
    if len(people) < s.folds:
        raise ValueError(f'motions of {len(people)} people, wanted at least {s.folds}')
    if len(dofs) == 0:
        raise ValueError('no angle of the body moves in the motions')
    size = {x: sum(map(len, data.of([x]).poses)) for x in people}
    largest_first = sorted(people, key=lambda x: (-size[x], x))
    groups = [largest_first[i :: s.folds] for i in range(s.folds)]
    held_out: dict[int, float] = {}
    counts = tuple(dict.fromkeys(s.components))
    for k in counts if progress is None else progress(counts, len(counts)):
        scores = []
        for group in groups:
            rest = data.of(x for x in people if x not in group)
            mixture = _mixture(rest, dofs, k, card, s)
            scores += [data.of([x]).score(mixture.log_density) for x in group]
        held_out[k] = float(np.mean(scores))
    best = max(held_out, key=lambda k: held_out[k])
    mixture = _mixture(data, dofs, best, card, s)
    plain = data.score(lambda poses: plain_log_density(data.body, dofs, poses))
    return LearnedPrior(mixture, held_out, plain, sum(size.values()), len(data.poses), len(people))


def plain_log_density(body: Body, dofs: Index, poses: Array) -> Array:
    """Log density (N,) of some angles of poses (N, d) under the Gaussians of the model file."""
    sigma = body.prior_sigma[dofs]
    z = (poses[:, dofs] - body.prior_mean[dofs]) / sigma
    return np.asarray(-0.5 * (z * z).sum(1) - np.log(sigma * np.sqrt(2.0 * np.pi)).sum())


def _mixture(
    data: PriorData, dofs: Index, count: int, card: Mapping[str, Any], s: PriorSettings
) -> AngleMixture:
    body, samples = data.body, data.samples(dofs)
    _, everything = samples.scatter()
    means = seeds_of(samples, count, np.random.default_rng(s.seed))
    n = len(dofs)
    broad = np.diag(body.prior_sigma[dofs] ** 2)
    # A floor, so that covariances are not singular.
    floor = np.diag(np.diagonal(everything)) * 0.01 + 1e-6 * np.eye(n)
    prior = CovariancePrior(s.shrinkage, s.compactness * everything + floor)
    start = GaussianMixture(
        np.array([s.broad_weight, *[(1.0 - s.broad_weight) / count] * count]),
        np.concatenate([body.prior_mean[None, dofs], means]),
        np.concatenate([broad[None], np.repeat(prior.scatter[None], count, axis=0)]),
    )
    found, _ = fitted_mixture(samples, start, prior, s.iterations)
    wider = found.covariances.copy()
    wider[1:] += s.bandwidth**2 * np.diag(np.diagonal(everything))
    components = GaussianMixture(found.weights, found.means, wider)
    names = tuple(body.dof_names[i] for i in dofs)
    return AngleMixture(body.skeleton, names, components, dict(card))
