"""Pose hypotheses: the data that the five steps from image to image share.

    predict -> propose -> optimise -> weigh -> select

A hypothesis starts with an ancestor, a set of jumped variables and an expected pose. Optimisation
adds a locally optimal pose, and weighing adds a weight; a selected hypothesis becomes a mode, with
covariances.
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
    """N weighted poses and their ancestry.

    Attributes:
        poses: (N, d) poses.
        log_weights: (N,) log weights of the ancestors; for modes, log posterior probabilities.
        ancestors: (N,) row of the previous image's mode that each hypothesis continues.
        expected: (N, d) centres of the motion prior.
        jumped: (N, d) degrees of freedom that jumped instead of following the motion prior.
        exchanges: (N, E) log probabilities that the detector exchanges sides, given earlier images;
            for modes, given this image too. NaN: unknown.
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
        """Selects rows."""
        names = self.__dataclass_fields__
        return type(self)(**{name: getattr(self, name)[rows] for name in names})

    def proposed(
        self, rows: Index, poses: Array, jumped: Mask, expected: Array | None = None
    ) -> Hypotheses:
        """Derives hypotheses at other poses (N, d).

        If all degrees of freedom of a hypothesis jump, the track is assumed wrong, so the
        probabilities of exchanged sides become unknown.

        Args:
            rows: (N,) rows of the source hypotheses.
            poses: (N, d) poses.
            jumped: (N, d) degrees of freedom that jump.
            expected: (N, d) centres of the motion prior; None: new values for jumped degrees of
                freedom, values of the source hypotheses for all other degrees of freedom.
        """
        if expected is None:
            expected = np.where(jumped, poses, self.expected[rows])
        again = np.all(jumped, axis=1, keepdims=True)
        return Hypotheses(
            poses,
            self.log_weights[rows],
            self.ancestors[rows],
            expected,
            jumped,
            np.where(again, np.nan, self.exchanges[rows]),
        )


def joined(parts: Sequence[Hypotheses]) -> Hypotheses:
    """Concatenates hypotheses."""
    names = Hypotheses.__dataclass_fields__
    arrays: list[Any] = [np.concatenate([getattr(x, name) for x in parts]) for name in names]
    return Hypotheses(*arrays)


@dataclass(frozen=True, eq=False)
class Optimised:
    """Hypotheses at their optima.

    Attributes:
        hypotheses: N hypotheses, whose poses are the starting points.
        minima: N optima, with Hessians of the Gaussian posterior.
    """

    hypotheses: Hypotheses
    minima: Minimum

    def __getitem__(self, rows: Index) -> Optimised:
        return Optimised(self.hypotheses[rows], self.minima[rows])

    def joined(self, other: Optimised) -> Optimised:
        """Concatenates with other hypotheses."""
        return Optimised(
            joined([self.hypotheses, other.hypotheses]), self.minima.joined(other.minima)
        )


@dataclass(frozen=True, eq=False)
class Modes(Hypotheses):
    """Optimised, weighed and selected hypotheses, which form the propagated mixture.

    Attributes:
        velocities: (N, d) velocities of the variables, per second.
        covariances: (N, d, d) covariances of the posterior, given all images so far.
        filtered: (N, d, d) covariances that would result from independent errors in each image.
        log_likelihoods: (N,) log likelihoods of the image.
        state_covariances: (N, n, n) propagated covariances of poses and velocities. For a random
            walk they are `filtered`; with velocities each image has a weight below 1, because
            errors persist.
        identities: (N,) persistent numbers, see `Identities`.
        origins: (N, M) probability that mode n continues mode m of the previous image; M is 0 at a
            start.
        back: (N,) whether each mode faces opposite to the heaviest, which is the first.
        facing: (N,) log odds of the facing direction of each mode, see `classes`.
        soles: (N, P, 3) points of the soles, m.
        contacts: (N, P) probabilities that sole points rest on the floor, see `body.foot_contact`.
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
        """Returns `count` modes with all values zero or empty; count is 0 without a track."""
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
    """Persistent numbers of the modes of a track, from 1 on.

    The heaviest descendant without a jump inherits the number of its ancestor. If every descendant
    jumped, the heaviest descendant with a degree of freedom that did not jump inherits it. All
    other modes get new numbers.
    """

    def __init__(self) -> None:
        self._last = 0

    def new(self, count: int) -> Index:
        """Returns unused numbers (count,)."""
        first, self._last = self._last + 1, self._last + count
        return np.arange(first, self._last + 1)

    def of(self, hypotheses: Hypotheses, before: Modes | None) -> Index:
        """Returns numbers (N,) for hypotheses that become modes.

        Args:
            hypotheses: N hypotheses, heaviest first.
            before: modes of the previous image; None: the track starts.
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
    """Creates N hypotheses, each of which is its own ancestor.

    Args:
        poses, log_weights: poses (N, d) and log weights (N,).
        exchanges: (N, E) log probabilities of exchanged sides; None: unknown.
    """
    everyone = np.arange(len(poses))
    still = np.zeros(poses.shape, dtype=np.bool_)
    if exchanges is None:
        exchanges = np.full((len(poses), usual_exchanges().shape[1]), np.nan)
    return Hypotheses(poses, log_weights, everyone, poses, still, exchanges)


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """Poses from an external single-image predictor, such as a mixture of experts.

    Attributes:
        mixture: mixture over poses (d,), with at least one positive weight.
        body: body of the poses, with its assumed lengths.

    Raises:
        ValueError: the dimensions of mixture and body differ, or all weights are 0.
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
        """Converts the mixture to a body of other lengths or level; distances scale with its size.

        Raises:
            ValueError: the body has other degrees of freedom.
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
        """Result of `seen_as`, and its depth reversals, which have nearly the same silhouettes."""
        seen = self.seen_as(body)
        return GaussianMixture(
            np.tile(0.5 * seen.weights, 2),
            np.concatenate([seen.means, reverse_depth(body, seen.means)]),
            np.tile(seen.covariances, (2, 1, 1)),
        )
