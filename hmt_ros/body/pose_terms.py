"""Energy terms over poses that share one pass of forward kinematics (KJS 2)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.self_intersection import self_intersection_energy
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy, Quadratic, add_energies


class FrameTerm(Protocol):
    """An energy term that reads a pose through the frames of its segments."""

    def energy(
        self, frames: Frames, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """The energy of N poses.

        Args:
            rows: (N,) the problem that each pose belongs to, as for `EnergyTerm`.
            derivatives: by the pose, which are wanted.
        """
        ...


@dataclass(frozen=True, eq=False)
class Posed:
    """A sum of terms over the frames of poses; an `EnergyTerm` over the poses themselves.

    Attributes:
        skeleton: of the body.
        terms: whose energies add, in this order.
    """

    skeleton: Skeleton
    terms: tuple[FrameTerm, ...]

    def energy(
        self,
        x: Array,
        rows: Index | None = None,
        *,
        derivatives: Derivatives = Derivatives.POSITIVE,
    ) -> Energy:
        """The energy of poses x (N, d); without rows, pose i belongs to problem i."""
        frames = forward(self.skeleton, x)
        rows = np.arange(len(x)) if rows is None else rows
        return add_energies(
            term.energy(frames, rows, derivatives=derivatives) for term in self.terms
        )


@dataclass(frozen=True, eq=False)
class AnglePrior:
    """The soft prior of the joint angles: an independent Gaussian for each; a `FrameTerm`.

    Attributes:
        body: with the means and standard deviations.
        weight: factor on the energy.
    """

    body: Body
    weight: float = 1.0

    @cached_property
    def quadratic(self) -> Quadratic:
        """The prior as an energy of the poses."""
        return Quadratic(self.body.prior_mean, self.weight * self.body.prior_sigma**-2.0)

    def energy(
        self, frames: Frames, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `FrameTerm`."""
        return self.quadratic.energy(frames.poses, rows, derivatives=derivatives)


@dataclass(frozen=True, eq=False)
class SelfIntersection:
    """The prior against parts of the body that run through each other; a `FrameTerm`.

    Attributes:
        body: whose parts.
        sigma: overlap that costs 1/2, m.
    """

    body: Body
    sigma: float

    def energy(
        self, frames: Frames, _rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `FrameTerm`."""
        value, gradient, hessian = self_intersection_energy(self.body, frames, sigma=self.sigma)
        return Energy(value, gradient, hessian) if derivatives else Energy(value)
