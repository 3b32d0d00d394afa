"""The images of a window as the observations of a smoother (VMS 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.inference.energy import Derivatives, Energy

Array = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """p(r_t | x_t) of the images themselves, the likelihood that the tracker minimises.

    Attributes:
        likelihood: the terms and the soft prior.
        observations: of the T images.
    """

    likelihood: ImageLikelihood
    observations: Sequence[Observation]

    @property
    def times(self) -> int:
        """T."""
        return len(self.observations)

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `EnergyTerm`; the rows are times, the Hessian is that of Gauss-Newton."""
        n, d = x.shape
        value, gradient, hessian = np.empty(n), np.empty((n, d)), np.empty((n, d, d))
        for t in np.unique(rows):
            at = rows == t
            found = self.likelihood.given(self.observations[t]).energy(x[at])
            value[at], gradient[at], hessian[at] = found.value, *found.derivatives()
        return Energy(value, gradient, hessian)
