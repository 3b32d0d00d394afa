"""Evidence of one image for all terms of the likelihood, computed once for all poses."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.optical_flow import optical_flow
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.terms.image_term import NO_FACTORS, ImageWindow
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.image.terms.registry import TERMS
from hmt_ros.image.terms.silhouette import Outline
from hmt_ros.inference.arrays import Array, Image, Mask
from hmt_ros.inference.threads import together

Box = tuple[int, int, int, int]

# Margin of the evidence window around the silhouette, px.
MARGIN = 48


@dataclass(frozen=True, eq=False)
class Beliefs:
    """Probabilities that the cues of an image show the person; factors on the cues' energies.

    Attributes:
        silhouette: probability that the silhouette shows the person.
        keypoints: (G,) probabilities that the groups of keypoints show the person, see
            `terms.keypoints`.
        depth: probability that the depths show the person.
        segments: for image terms and keypoints by name, additional factors (S,) on the energies at
            each segment; without an entry all factors are 1.
    """

    silhouette: float
    keypoints: Array
    depth: float
    segments: Mapping[str, Array] = field(default_factory=dict)

    def of_term(self, name: str) -> float:
        """Factor on the weight of an image term."""
        return {'coverage': self.silhouette, 'depth': self.depth}.get(name, 1.0)

    def of_segments(self, name: str) -> Array:
        """Factors (S,) on the energies of an image term or of keypoints; (0,) if all are 1."""
        return self.segments.get(name, NO_FACTORS)


@dataclass(frozen=True, eq=False)
class Observation:
    """Evidence of one image about a person.

    Attributes:
        silhouette: (H, W) foreground; None if unknown, or if it probably does not show the person.
        keypoints: joints seen in the image; None if unknown.
        evidence: evidence for each term by name; terms without evidence in the image are left out.
        foreground: (H, W) pixels that differ from the background, kept even if `silhouette` was
            rejected; None: unknown.
        depths: depth image, m, kept even if depths were rejected as evidence; None: unknown.
        flow: optical flow from the previous image, two channels, px; None if missing.
        others: (H, W) pixels that other people cover or possibly cover; None if missing.
        hidden: (S,) segments hidden by objects, for which the image gives no evidence; None if
            missing.
        beliefs: probabilities of the cues; None: all are 1.
        magnification: px/m at the distance of the person; 0 if unknown: the noise of people's
            contours is then ignored.
    """

    silhouette: Mask | None = None
    keypoints: Keypoints | None = None
    evidence: Mapping[str, Any] = field(default_factory=dict)
    foreground: Mask | None = None
    depths: ImageMap | None = None
    flow: ImageMap | None = None
    others: Mask | None = None
    hidden: Mask | None = None
    beliefs: Beliefs | None = None
    magnification: float = 0.0

    def factors(self, name: str) -> Array:
        """Factors (S,) on the energies of a term at each segment; (0,) if all are 1."""
        believed = NO_FACTORS if self.beliefs is None else self.beliefs.of_segments(name)
        if self.hidden is None:
            return believed
        return np.where(self.hidden, 0.0, believed if len(believed) else 1.0)

    @property
    def outline(self) -> Outline | None:
        """Samples on the outline of the silhouette, the evidence of the coverage term."""
        return self.evidence.get('coverage')


def observe(
    image: Image,
    silhouette: Mask | None = None,
    keypoints: Keypoints | None = None,
    window: Box | None = None,
    last_image: Image | None = None,
    wanted: Collection[str] | None = None,
    unsure: Mask | None = None,
    others: Mask | None = None,
    depth: NDArray[np.floating] | None = None,
    threads: int = 0,
) -> Observation:
    """Extracts the evidence for the terms of the likelihood from an image.

    Args:
        image: (H, W, 3) BGR uint8.
        silhouette: (H, W) foreground; None or empty: the silhouette is not used.
        window: box (left, top, right, bottom) that probably contains the person, used if the
            silhouette is missing; None: the whole image.
        last_image: the previous image, of the same size, for the optical flow; None: the flow is
            not computed.
        wanted: names of the terms whose evidence is computed; None: all.
        unsure: (H, W) pixels that possibly belong to the silhouette; None if missing.
        others: (H, W) pixels that other people cover; None if missing.
        depth: (H, W) depth along the axis of the camera, m; None: unknown. 0, NaN and values out of
            range are no evidence.

    Raises:
        ValueError: the image is not (H, W, 3) uint8, or shapes are inconsistent.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f'image must be (H, W, 3) uint8, saw {image.shape} {image.dtype}')
    if silhouette is not None and silhouette.shape != image.shape[:2]:
        raise ValueError(f'silhouette {silhouette.shape} for an image {image.shape[:2]}')
    if depth is not None and depth.shape != image.shape[:2]:
        raise ValueError(f'depth {depth.shape} for an image {image.shape[:2]}')
    known = silhouette if silhouette is not None and silhouette.any() else None
    box = window
    if known is not None:
        # The person can be anywhere behind other people.
        box = _box(known if others is None else known | others)
    left, top, right, bottom = _grown(box, MARGIN, image.shape)
    inside = slice(top, bottom), slice(left, right)

    def cut(whole: NDArray[Any] | None) -> Any:
        """Cuts the window out of an array; masks become 0 and 1."""
        if whole is None:
            return None
        part = np.ascontiguousarray(whole[inside])
        return part.view(np.uint8) if part.dtype == np.bool_ else part

    measured = depth
    if depth is not None and others is not None:
        measured = np.where(others, 0.0, depth)
    part = ImageWindow(
        cut(image),
        left,
        top,
        cut(known),
        cut(last_image),
        cut(None if known is None else unsure),
        cut(others),
        cut(measured),
    )
    terms = [term for term in TERMS if wanted is None or term.name in wanted]
    takes = [partial(term.evidence, part) for term in terms]
    flow, *found = together([partial(optical_flow, part), *takes], threads)
    evidence = {term.name: x for term, x in zip(terms, found, strict=True) if x is not None}
    return Observation(known, keypoints, evidence, flow=flow, others=others)


def _box(mask: Mask) -> Box:
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    return x, y, x + w, y + h


def _grown(box: Box | None, margin: int, shape: tuple[int, ...]) -> Box:
    height, width = shape[:2]
    if box is None:
        return 0, 0, width, height
    left, top, right, bottom = box
    left, top = max(0, min(left - margin, width - 2)), max(0, min(top - margin, height - 2))
    return (
        left,
        top,
        min(width, max(right + margin, left + 2)),
        min(height, max(bottom + margin, top + 2)),
    )
