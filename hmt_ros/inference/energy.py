"""Energies: minus the logarithms of the factors of a posterior.

    E(x) = - sum_i log p_i(x),     g = dE/dx,     H ~ d2E/dx2

Every factor of a density over x is an `EnergyTerm`. The energy of a posterior is the sum of its
terms, which every optimiser accepts (KJS 2 and 3.2, VMS 5).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, Protocol

import numpy as np

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product


class Derivatives(IntEnum):
    """Derivatives requested from an energy."""

    NONE = 0
    GRADIENT = 1  # the gradient; a term may return a Hessian with it
    POSITIVE = 2  # gradient and a positive semi-definite Hessian (Gauss-Newton or majorising)
    EXACT = 3  # gradient and the exact Hessian; as POSITIVE if the term has no exact Hessian


class Energy(NamedTuple):
    """Energies of N points; supports addition.

    Attributes:
        value: (N,) energies, nats.
        gradient: (N, d) gradients; None: not requested.
        hessian: (N, d, d) Hessians; None: not requested.
    """

    value: Array
    gradient: Array | None = None
    hessian: Array | None = None

    def derivatives(self) -> tuple[Array, Array]:
        """Gradient and Hessian.

        Raises:
            ValueError: a derivative was not computed.
        """
        if self.gradient is None or self.hessian is None:
            raise ValueError('the energy was computed without derivatives')
        return self.gradient, self.hessian


class EnergyTerm(Protocol):
    """Minus the logarithm of one factor of a posterior."""

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """Return the energy at points x (n, d).

        Args:
            rows: (n,) index of each point's problem, for terms with data (centre, texture or time)
                that differ between problems.
        """
        ...


def add_energies(energies: Iterable[Energy]) -> Energy:
    """Add energies of the same points, in the given order."""
    first, *others = energies
    value, gradient, hessian = first
    if not others:
        return first
    value = value.copy()
    if gradient is not None and hessian is not None:
        gradient, hessian = gradient.copy(), hessian.copy()
    for other in others:
        value += other.value
        if gradient is not None and hessian is not None:
            own = other.derivatives()
            gradient += own[0]
            hessian += own[1]
    return Energy(value, gradient, hessian)


@dataclass(frozen=True, eq=False)
class EnergyFunction:
    """A term that wraps a function.

    Attributes:
        function: function of points (n, d) and rows (n,) that returns value, gradient and any kind
            of Hessian.
    """

    function: Callable[[Array, Index], tuple[Array, Array, Array]]

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `EnergyTerm`; derivatives are always returned."""
        return Energy(*self.function(x, rows))


@dataclass(frozen=True, eq=False)
class Sum:
    """Energy of a product of factors: the sum of their energies, in the given order."""

    terms: tuple[EnergyTerm, ...]

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `EnergyTerm`."""
        return add_energies(term.energy(x, rows, derivatives=derivatives) for term in self.terms)


@dataclass(frozen=True, eq=False)
class Quadratic:
    """Minus the logarithm of a Gaussian, up to a constant.

        E(x) = 1/2 (x - m)' P (x - m)

    Attributes:
        centres: centres m, (d,) for all problems or (N, d).
        precisions: precisions P, diagonal (d,) or full (d, d) for all problems, or (N, d, d).
    """

    centres: Array
    precisions: Array

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `EnergyTerm`."""
        if self.precisions.ndim == 1:
            offset = x - _of_rows(self.centres, rows)
            value = 0.5 * product(offset * offset, self.precisions)
            if not derivatives:
                return Energy(value)
            shape = (*x.shape, x.shape[1])
            hessian = np.broadcast_to(np.diag(self.precisions), shape)
            return Energy(value, offset * self.precisions, hessian)
        offset, pulled, precisions = _pulls(self, x, rows)
        value = 0.5 * (offset * pulled).sum(1)
        return Energy(value, pulled, precisions) if derivatives else Energy(value)


@dataclass(frozen=True, eq=False)
class Student:
    """Minus the logarithm of a Student density, up to a constant: a Gaussian with heavy tails.

        E(x) = (nu + d)/2 log(1 + D/nu),     D = (x - m)' P (x - m)

    The Gauss-Newton Hessian is s P with the shrinkage s = (nu + d) / (nu + D) > 0.

    Attributes:
        centres: centres m, (d,) for all problems or (N, d).
        precisions: precisions P, (d, d) for all problems, or (N, d, d).
        degrees_of_freedom: degrees of freedom nu.
    """

    centres: Array
    precisions: Array
    degrees_of_freedom: float

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `EnergyTerm`."""
        nu, d = self.degrees_of_freedom, x.shape[1]
        offset, pulled, precisions = _pulls(self, x, rows)
        distance = (offset * pulled).sum(1)
        value = 0.5 * (nu + d) * elementary.log1p(distance / nu)
        if not derivatives:
            return Energy(value)
        shrinkage = (nu + d) / (nu + distance)
        return Energy(value, shrinkage[:, None] * pulled, shrinkage[:, None, None] * precisions)


def _pulls(term: Quadratic | Student, x: Array, rows: Index) -> tuple[Array, Array, Array]:
    """Return x - m (n, d), P (x - m) (n, d) and P (n, d, d) of each point."""
    offset = x - _of_rows(term.centres, rows)
    if term.precisions.ndim == 2:
        shape = (*x.shape, x.shape[1])
        return offset, product(offset, term.precisions), np.broadcast_to(term.precisions, shape)
    precisions = term.precisions[rows]
    return offset, np.einsum('nij,nj->ni', precisions, offset), precisions


def _of_rows(centres: Array, rows: Index) -> Array:
    return centres[rows] if centres.ndim == 2 else centres
