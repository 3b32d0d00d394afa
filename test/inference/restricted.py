"""A term over some of the variables, with which tests compare compiled sums."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy, EnergyTerm


@dataclass(frozen=True, eq=False)
class Restricted:
    """A term over some of the variables; the others are constant.

    Attributes:
        term: term over all d variables.
        point: values (d,) of all variables.
        free: indices (f,) of the variables that may change.
    """

    term: EnergyTerm
    point: Array
    free: Index

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """The energy at values x (n, f) of the free variables; see `EnergyTerm`."""
        whole = np.repeat(self.point[None], len(x), axis=0)
        whole[:, self.free] = x
        value, gradient, hessian = self.term.energy(whole, rows, derivatives=derivatives)
        if gradient is not None:
            gradient = gradient[:, self.free]
        if hessian is not None:
            hessian = hessian[:, self.free[:, None], self.free]
        return Energy(value, gradient, hessian)
