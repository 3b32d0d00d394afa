"""Hypotheses about the pose, from one image to the next: the record that the five steps share.

    predict -> propose -> optimise -> weigh -> select

A hypothesis is born with an ancestor, jumps, and a pose where it is expected. It gets a pose that
is locally optimal and a weight; if it is selected it is a mode, with covariances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.mirror import relevelled, reverse_depth
from hmt_ros.core import elementary
from hmt_ros.image.keypoint_schemes import usual_exchanges
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.linear_algebra import log_sum_exp
from hmt_ros.inference.mixture import GaussianMixture

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """N weighted poses, and how they came about.

    Attributes:
        poses: (N, d).
        log_weights: (N,) of the ancestors; of modes log posterior probabilities.
        ancestors: (N,) mode of the image before that each comes from.
        expected: (N, d) pose that the motion prior is centred at.
        jumped: (N, d) degrees of freedom that did not move there, but jumped.
        exchanges: (N, E) log probabilities that the detector exchanges sides: before the image; of
            modes after it. NaN: nothing is known of the detector.
    """

    poses: Array
    log_weights: Array
    ancestors: Index
    expected: Array
    jumped: NDArray[np.bool_]
    exchanges: Array

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, rows: Index | slice) -> Self:
        """Some of them."""
        names = self.__dataclass_fields__
        return type(self)(**{name: getattr(self, name)[rows] for name in names})

    def proposed(
        self, rows: Index, poses: Array, jumped: Mask, expected: Array | None = None
    ) -> Hypotheses:
        """Hypotheses at other poses (N, d).

        One that has jumped with all degrees of freedom says that the track was wrong: of the
        detector nothing is known then.

        Args:
            rows: (N,) of these hypotheses, that they come from.
            poses: (N, d).
            jumped: (N, d) degrees of freedom that have jumped.
            expected: (N, d) centres of the motion prior; None: where they have jumped to, else
                those of the hypotheses that they come from.
        """
        if expected is None:
            expected = np.where(jumped, poses, self.expected[rows])
        anew = np.all(jumped, axis=1, keepdims=True)
        return Hypotheses(
            poses,
            self.log_weights[rows],
            self.ancestors[rows],
            expected,
            jumped,
            np.where(anew, np.nan, self.exchanges[rows]),
        )


def joined(parts: Sequence[Hypotheses]) -> Hypotheses:
    """All hypotheses of some proposals."""
    names = Hypotheses.__dataclass_fields__
    arrays: list[Any] = [np.concatenate([getattr(x, name) for x in parts]) for name in names]
    return Hypotheses(*arrays)


@dataclass(frozen=True, eq=False)
class Optimised:
    """Hypotheses at their optima.

    Attributes:
        hypotheses: N of them; their poses are where they started from.
        minima: N rows; Hessians are those of the Gaussian posterior.
    """

    hypotheses: Hypotheses
    minima: Minimum

    def __getitem__(self, rows: Index) -> Optimised:
        return Optimised(self.hypotheses[rows], self.minima[rows])

    def joined(self, other: Optimised) -> Optimised:
        """These and others."""
        return Optimised(
            joined([self.hypotheses, other.hypotheses]), self.minima.joined(other.minima)
        )


@dataclass(frozen=True, eq=False)
class Modes(Hypotheses):
    """Hypotheses that were optimised, weighed and selected: the mixture that is carried on.

    Attributes:
        velocities: (N, d) per second.
        covariances: (N, d, d) of the posterior, as certain as all images so far make them.
        filtered: (N, d, d) covariances as if errors were independent from image to image.
        log_likelihoods: (N,) of the image.
        state_covariances: (N, n, n) of poses and velocities, which are propagated. For a random
            walk they are `filtered`; with velocities each image counts with a share, because errors
            last.
        identities: (N,) see `Identities`.
        origins: (N, M) probability that each continues mode m of the image before; M is 0 where
            the modes begin.
        back: (N,) modes that face the other way than the heaviest, which is the first.
        facing: (N,) log odds of the way that each faces, see `classes`.
        soles: (N, P, 3) points of the soles, m.
        contacts: (N, P) probabilities that these rest on the floor, see `contact`.
    """

    velocities: Array
    covariances: Array
    filtered: Array
    log_likelihoods: Array
    state_covariances: Array
    identities: Index
    origins: Array
    back: Mask
    facing: Array
    soles: Array
    contacts: Array

    @classmethod
    def blank(cls, count: int, dimension: int) -> Modes:
        """K modes of which nothing is known yet; none where there is no track."""
        numbers, vectors = np.zeros(count), np.zeros((count, dimension))
        matrices, nothing = np.zeros((count, dimension, dimension)), np.zeros((count, 0))
        return cls(
            **vars(new_hypotheses(vectors, numbers)),
            velocities=vectors,
            covariances=matrices,
            filtered=matrices,
            log_likelihoods=numbers,
            state_covariances=matrices,
            identities=np.zeros(count, dtype=np.intp),
            origins=nothing,
            back=np.zeros(count, dtype=np.bool_),
            facing=numbers,
            soles=nothing[:, :, None].repeat(3, axis=2),
            contacts=nothing,
        )

    @cached_property
    def mixture(self) -> GaussianMixture:
        """The modes as a mixture over poses."""
        weights = elementary.exp(self.log_weights - log_sum_exp(self.log_weights))
        return GaussianMixture(weights, self.poses, self.covariances)


class Identities:
    """Numbers of the modes of a track, from 1 on, that last from image to image.

    A mode keeps the number of its ancestor if it is the heaviest of the descendants that moved
    there, or, where all of them have jumped with some limb, the heaviest of these. Every other
    mode, and one that was placed anew as a whole, gets a number that no mode has had before.
    """

    def __init__(self) -> None:
        self._last = 0

    def new(self, count: int) -> Index:
        """Numbers (count,) that no mode has had."""
        first, self._last = self._last + 1, self._last + count
        return np.arange(first, self._last + 1)

    def of(self, hypotheses: Hypotheses, before: Modes | None) -> Index:
        """Numbers (N,) of hypotheses that become modes, heaviest first.

        Args:
            hypotheses: N.
            before: modes of the image before; None: they begin.
        """
        if before is None:
            return self.new(len(hypotheses))
        ancestors, jumped = hypotheses.ancestors.tolist(), hypotheses.jumped
        heirs: dict[int, int] = {}
        for candidates in (~jumped.any(1), ~jumped.all(1)):
            taken = set(heirs)
            for k in np.flatnonzero(candidates).tolist():
                if ancestors[k] not in taken:
                    heirs.setdefault(ancestors[k], k)
        result = np.zeros(len(ancestors), dtype=np.intp)
        for ancestor, heir in heirs.items():
            result[heir] = before.identities[ancestor]
        fresh = np.flatnonzero(result == 0)
        result[fresh] = self.new(len(fresh))
        return result


def new_hypotheses(poses: Array, log_weights: Array, exchanges: Array | None = None) -> Hypotheses:
    """Hypotheses (N, d), each its own ancestor.

    Args:
        poses, log_weights: (N, d), (N,).
        exchanges: (N, E) log probabilities of exchanged sides; None: nothing is known.
    """
    everyone = np.arange(len(poses))
    still = np.zeros(poses.shape, dtype=np.bool_)
    if exchanges is None:
        exchanges = np.full((len(poses), usual_exchanges().shape[1]), np.nan)
    return Hypotheses(poses, log_weights, everyone, poses, still, exchanges)


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """Poses that an external single-image predictor expects, such as a mixture of experts.

    Attributes:
        mixture: over poses (d,), with some weight above 0.
        body: of the poses, at the lengths that were assumed.

    Raises:
        ValueError: a mixture that is not over poses of the body.
    """

    mixture: GaussianMixture
    body: Body

    def __post_init__(self) -> None:
        if self.mixture.dimension != self.body.dimension:
            raise ValueError(
                f'a prediction for {self.body.name} has {self.body.dimension} dimensions, saw '
                f'{self.mixture.dimension}'
            )
        if not self.mixture.weights.sum() > 0:
            raise ValueError('a prediction has no weight')

    def seen_as(self, body: Body) -> GaussianMixture:
        """The same for a person of other lengths or level, at a distance in proportion to the size.

        Raises:
            ValueError: a body with other degrees of freedom.
        """
        if body.dof_names != self.body.dof_names:
            raise ValueError(
                f'a prediction for {self.body.name}, of {self.body.dimension} dimensions, saw the '
                f'body {body.name}, of {body.dimension}'
            )
        kept = relevelled(self.body, self.mixture[self.mixture.weights > 0].normalised(), body)
        means = np.array(kept.means)
        means[:, :3] *= body.scale / self.body.scale
        return GaussianMixture(
            kept.weights, np.clip(means, body.lower, body.upper), kept.covariances
        )

    def both_ways(self, body: Body) -> GaussianMixture:
        """As `seen_as`, with the reversals in depth, which have nearly the same silhouettes."""
        seen = self.seen_as(body)
        return GaussianMixture(
            np.tile(0.5 * seen.weights, 2),
            np.concatenate([seen.means, reverse_depth(body, seen.means)]),
            np.tile(seen.covariances, (2, 1, 1)),
        )
