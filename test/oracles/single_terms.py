"""Energies of single terms, which tests compare with formulas and with sums."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.image.likelihood import ImageLikelihood, ObservedImage
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import CompiledTerm, PoseEnergy
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy, add_energies

CAMERA = Camera(330.0, 330.0, 159.5, 119.5, 320, 240)


@dataclass(frozen=True, eq=False)
class OneByOne:
    """A sum of terms that are evaluated one after the other; an `EnergyTerm` over all variables."""

    likelihood: ImageLikelihood
    terms: tuple[CompiledTerm | FrameTerm, ...]

    def energy(
        self,
        x: Array,
        rows: Index | None = None,
        *,
        derivatives: Derivatives = Derivatives.POSITIVE,
    ) -> Energy:
        """See `EnergyTerm`."""
        return add_energies(
            PoseEnergy(self.likelihood, (term,)).energy(x, rows, derivatives=derivatives)
            for term in self.terms
        )


def energy_of(
    term: CompiledTerm,
    body: Body,
    poses: Array,
    rows: Index | None = None,
    *,
    camera: Camera = CAMERA,
    derivatives: Derivatives = Derivatives.POSITIVE,
) -> Energy:
    """The energy of a term at poses (N, d) of a body; without rows, each is its own problem."""
    one = OneByOne(ImageLikelihood(body, camera), (term,))
    return one.energy(np.atleast_2d(poses), rows, derivatives=derivatives)


def image_energy(
    likelihood: ImageLikelihood,
    poses: Array,
    observation: Observation,
    derivatives: Derivatives = Derivatives.POSITIVE,
) -> Energy:
    """The energy of only the image terms at poses (N, d)."""
    image = ObservedImage(likelihood, observation)
    return PoseEnergy(likelihood, (image,)).energy(poses, derivatives=derivatives)
