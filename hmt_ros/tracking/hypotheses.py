"""Hypotheses about the pose, from one image to the next: the record that the five steps share.

    predict -> propose -> optimise -> weigh -> select

A hypothesis is born with an ancestor, jumps, and a pose where it is expected. It gets a pose that
is locally optimal and a weight; if it is selected it is a mode, with covariances.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum
from hmt_ros.inference.mixture import GaussianMixture

if TYPE_CHECKING:
    from typing_extensions import Self

# Modes whose log weight is less than that of the heaviest by at most this, nats, show places where
# the person may be.
LIKELY = 4.0


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """N weighted poses, and how they came about.

    Attributes:
        poses: (N, d).
        log_weights: (N,) of the ancestors; of modes log posterior probabilities.
        ancestors: (N,) mode of the image before that each comes from.
        expected: (N, d) pose that the motion prior is centred at.
        jumped: (N, d) degrees of freedom that did not move there, but jumped.
    """

    poses: Array
    log_weights: Array
    ancestors: Index
    expected: Array
    jumped: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.poses)

    def __getitem__(self, rows: Index) -> Self:
        """Some of them."""
        parts: dict[str, Any] = {x.name: getattr(self, x.name)[rows] for x in fields(self)}
        return replace(self, **parts)

    def joined(self, other: Self) -> Self:
        """These and others."""
        parts: dict[str, Any] = {
            x.name: np.concatenate([getattr(self, x.name), getattr(other, x.name)])
            for x in fields(self)
        }
        return replace(other, **parts)


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
        return Optimised(self.hypotheses.joined(other.hypotheses), self.minima.joined(other.minima))


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
    """

    velocities: Array
    covariances: Array
    filtered: Array
    log_likelihoods: Array
    state_covariances: Array
    identities: Index
    origins: Array

    @property
    def mixture(self) -> GaussianMixture:
        """The modes as a mixture over poses."""
        weights = np.exp(self.log_weights - np.logaddexp.reduce(self.log_weights))
        return GaussianMixture(weights, self.poses, self.covariances)


class Identities:
    """Numbers of the modes of a track, from 1 on, that last from image to image.

    A mode keeps the number of its ancestor if it is the heaviest of the descendants that moved
    there, or, where all of them have jumped with some limb, the heaviest of these. Every other
    mode, and one that was placed anew as a whole, gets a number that no mode has had before.
    """

    def __init__(self) -> None:
        self._last = 0

    def restart(self) -> None:
        """Counts from 1 again: a track begins."""
        self._last = 0

    def new(self, count: int) -> Index:
        """Numbers (count,) that no mode has had."""
        first, self._last = self._last + 1, self._last + count
        return np.arange(first, self._last + 1)

    def inherited(self, before: Index, ancestors: Index, jumped: NDArray[np.bool_]) -> Index:
        """Numbers (N,) of the modes of an image, heaviest first.

        Args:
            before: (K,) of the modes of the image before.
            ancestors: (N,) mode of that image that each comes from.
            jumped: (N, d) degrees of freedom that did not move, but jumped.
        """
        heirs: dict[int, int] = {}
        for candidates in (~jumped.any(1), ~jumped.all(1)):
            taken = set(heirs)
            for k in np.flatnonzero(candidates):
                if int(ancestors[k]) not in taken:
                    heirs.setdefault(int(ancestors[k]), int(k))
        result = np.zeros(len(ancestors), dtype=np.intp)
        for ancestor, heir in heirs.items():
            result[heir] = before[ancestor]
        fresh = np.flatnonzero(result == 0)
        result[fresh] = self.new(len(fresh))
        return result


def new_hypotheses(poses: Array, log_weights: Array) -> Hypotheses:
    """Hypotheses (N, d) that come from nothing before: each its own ancestor."""
    everyone = np.arange(len(poses))
    still = np.zeros(poses.shape, dtype=np.bool_)
    return Hypotheses(poses, log_weights, everyone, poses, still)
