"""Likelihood p(r_t | x_t) of the images of a sequence, as observations of a motion (VMS 5).

    E_t(x) = a_i E_image(x) + E_keypoints(x; a_k, a_l) + a_p (E_prior(x) + E_known(x))

Errors persist from image to image. As in the filter, the energy of a cue g is therefore multiplied
by a share a_g, which depends on the time since the previous image (`inference.error_model`). The
prior of an exchange of sides is not scaled. A persistent error does not change the shape of a
motion. If `of_changes` is set, the terms of the image are therefore scaled by
`CueErrors.of_changes` instead, and covariances are enlarged by `CueErrors.persistence_ratio`
afterwards. The share of keypoints remains a_k, because their errors drift, and a motion would
follow the drift.

Each image keeps the bone lengths and the flesh with which its poses were estimated. Later estimates
of lengths and flesh move the root along the line of sight, which would look like motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from hmt_ros.body.ground_terms import GroundTerm
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.image.likelihood import ImageLikelihood
from hmt_ros.image.observation import Observation
from hmt_ros.image.pose_energy import PoseEnergy
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy, add_energies
from hmt_ros.inference.error_model import ERRORS, seconds


@dataclass(frozen=True, eq=False)
class SeenImage:
    """Evidence of one image about a person, with the probabilities of the cues.

    Attributes:
        likelihood: likelihood of images of this person.
        observation: evidence of the image.
        known: additional energy terms, for gravity and floor.
    """

    likelihood: ImageLikelihood
    observation: Observation
    known: tuple[FrameTerm | GroundTerm, ...] = ()

    def levelled(self, level: Array) -> SeenImage:
        """The same image for poses whose root angles are relative to the axes `level`."""
        body = self.likelihood.body
        if np.array_equal(body.level, level):
            return self
        return replace(self, likelihood=replace(self.likelihood, body=body.levelled(level)))


@dataclass(frozen=True, eq=False)
class ImageSequence:
    """Energies -log p(r_t | x_t) of T images; an `EnergyTerm` whose rows are times.

    Attributes:
        images: the T images.
        shares: for each image, the shares a_g by name of the cue.
    """

    images: Sequence[SeenImage]
    shares: Sequence[dict[str, float]]

    @classmethod
    def of(
        cls, images: Sequence[SeenImage], stamps_ns: Sequence[int], *, of_changes: bool = False
    ) -> ImageSequence:
        """The sequence of images with these stamps (T,), without evidence before the first image.

        Args:
            of_changes: whether the share of the image terms is `CueErrors.of_changes`.
        """
        intervals = [np.inf, *(seconds(b - a) for a, b in pairwise(stamps_ns))]
        shares = [
            {
                name: errors.of_changes(dt) if of_changes and name == 'image' else errors.share(dt)
                for name, errors in ERRORS.items()
            }
            for dt in intervals
        ]
        return cls(images, shares)

    @property
    def times(self) -> int:
        """Number T of images."""
        return len(self.images)

    def energy(
        self, x: Array, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `EnergyTerm`; the rows are times. Either all derivatives are returned or none."""
        n, d = x.shape
        asked = n if derivatives else 0
        value, gradient, hessian = np.empty(n), np.empty((asked, d)), np.empty((asked, d, d))
        for t in np.unique(rows).tolist():
            at = rows == t
            parts = [
                _scaled(term.energy(x[at], derivatives=derivatives), share)
                for term, share in self._terms[t]
            ]
            found = add_energies(parts)
            value[at] = found.value
            if derivatives:
                gradient[at], hessian[at] = found.derivatives()
        return Energy(value, gradient, hessian) if derivatives else Energy(value)

    @cached_property
    def _terms(self) -> list[list[tuple[PoseEnergy, float]]]:
        """For each time, sums of terms, with a factor on each sum."""
        result = []
        for image, share in zip(self.images, self.shares, strict=True):
            # Callers may run in several threads, which already use all cores.
            likelihood = replace(image.likelihood, threads=1)
            seen = likelihood.seen(
                image.observation, share=share['keypoints'], lifted_share=share['lifted']
            )
            rest = (*likelihood.priors, *image.known)
            sums = (seen[:1], share['image']), (seen[1:], 1.0), (rest, share['prior'])
            result.append([(PoseEnergy(likelihood, terms), a) for terms, a in sums if terms])
        return result


def _scaled(energy: Energy, factor: float) -> Energy:
    """An energy and its derivatives, times a factor."""
    value, gradient, hessian = energy
    if gradient is None or hessian is None:
        return Energy(factor * value)
    return Energy(factor * value, factor * gradient, factor * hessian)
