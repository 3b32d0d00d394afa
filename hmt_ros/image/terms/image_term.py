"""The parts of which a term of the image likelihood consists.

Each term has one file in this folder, with its default settings, the extraction of its evidence
from an image, and one `ImageTerm` that refers to both; `registry` lists the terms. The energy of a
term is one header in `core/terms`; `core/terms.h` lists the headers. No other code depends on the
terms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.sampling import ImageMap
from hmt_ros.inference.arrays import Array, Image

# Placeholders for a missing mask and a missing map.
NO_MASK = np.zeros((0, 0), np.uint8)
NO_MAP = ImageMap(np.zeros((2, 2, 2), np.float32))
# Factors on the energies at segments if all factors are 1.
NO_FACTORS = np.zeros(0)


@dataclass(frozen=True)
class TermSettings:
    """Settings of one term of the likelihood.

    Attributes:
        weight: Number of independent measurements that the term represents (a plain factor for
            keypoints); 0 switches the term off.
        sigma: Standard deviation of one measurement, px; for keypoints a factor on the detector's
            standard deviation, for depths in m. For contours, the difference between contours of
            people and of the model is added.
        scale: Width of the Geman-McClure kernel, in standard deviations.
        growth: Standard deviation of a depth that is proportional to the depth squared, 1/m.
    """

    weight: float
    sigma: float
    scale: float
    growth: float = 0.0

    def __post_init__(self) -> None:
        if not (self.weight >= 0 and self.sigma > 0 and self.scale > 0 and self.growth >= 0):
            raise ValueError(
                f'a term needs weight >= 0, sigma > 0, scale > 0 and growth >= 0, saw {self}'
            )


@dataclass(frozen=True, eq=False)
class ImageWindow:
    """The part of an image from which evidence is taken.

    Attributes:
        image: (h, w, 3) BGR.
        left, top: column and row of the window's first pixel in the whole image.
        mask: (h, w) silhouette, 0 or 1; None: unknown.
        unsure: (h, w) pixels that possibly belong to the silhouette, 0 or 1; None if missing.
        last_image: (h, w, 3) the same part of the previous image; None if missing.
        others: (h, w) pixels that show or possibly show other people, 0 or 1, and are evidence
            neither for nor against a pose; None if missing.
        depth: (h, w) the same part of the depth image, m; None if missing.
    """

    image: Image
    left: int
    top: int
    mask: Image | None
    last_image: Image | None
    unsure: Image | None = None
    others: Image | None = None
    depth: NDArray[np.floating] | None = None

    @property
    def widest(self) -> Image | None:
        """Union (h, w) of silhouette, unsure pixels and other people, 0 or 1; None if unknown."""
        widest = self.mask
        if widest is not None:
            for more in (self.unsure, self.others):
                widest = widest if more is None else widest | more
        return widest

    def as_map(self, channels: NDArray[np.float32]) -> ImageMap:
        """Wraps values (C, h, w) in the window as an `ImageMap` of the whole image."""
        return ImageMap(channels, self.left, self.top)


class Weighting(NamedTuple):
    """`TermSettings` as input of the compiled core; a weight of 0 switches the term off.

    `magnification`, px/m at the person, converts errors of the body to pixels. `segments` contains
    factors (S,) on the energies at each segment, or (0,) if all factors are 1.
    """

    weight: float
    sigma: float
    scale: float
    magnification: float
    growth: float = 0.0
    segments: Array = NO_FACTORS


@dataclass(frozen=True, eq=False)
class ImageTerm:
    """One term of the image likelihood.

    Attributes:
        name: name of the term; settings and evidence have the same name.
        meaning: description of the compared quantities; the descriptions of the term's parameters
            start with it.
        settings: default settings.
        evidence: function that extracts the term's evidence from an image; returns None if missing.
        inputs: function that makes the inputs of the core: a NamedTuple that starts with the
            `Weighting`; its fields fill the struct of the term's header. Without evidence (None)
            the weight is 0, and arrays are empty but have the same types.
        needs_contour: whether the term needs the contour of the model.
    """

    name: str
    meaning: str
    settings: TermSettings
    evidence: Callable[[ImageWindow], Any]
    inputs: Callable[[Weighting, Any], Any]
    needs_contour: bool = False
