"""The silhouette (KJS 2; Sminchisescu and Triggs, IJRR 2003).

    coverage      E(x) = w / M sum_m rho(|u_i(m)(x) - s_m| / sigma)

s_m are M samples of the outline of the silhouette, u_i are points of the model's contour, and i(m)
is the index of the point nearest to sample m. The energy is small if the outline of the silhouette
lies on the contour of the model.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from hmt_ros.core import sample_outline
from hmt_ros.image.terms.image_term import (
    NO_MASK,
    ImageTerm,
    ImageWindow,
    TermSettings,
    Weighting,
)
from hmt_ros.inference.arrays import Array

# Approximate number of samples on the outline.
OUTLINE_POINTS = 120
# Minimum length of an outline that is sampled, px.
MIN_OUTLINE_LENGTH = 12


class Outline(NamedTuple):
    """M sample points on the outline of a silhouette.

    Attributes:
        pixels: (M, 2) positions of the samples.
        normals: (M, 2) unit normals that point out of the silhouette.
        beliefs: (M,) probability that each sample belongs to the person's outline, 0 to 1.
    """

    pixels: Array
    normals: Array
    beliefs: Array


class CoverageInputs(NamedTuple):
    """Inputs of `core/terms/coverage.h`.

    Attributes:
        term: weight and noise of the term.
        outline: samples on the outline.
        explained: (X, M) maximum energy of each sample; one row per pose, or a single row.
        costs: (N, M) buffer for the energy of each sample, an output; (0, M): not computed.
    """

    term: Weighting
    outline: Outline
    explained: Array
    costs: Array


def outline(window: ImageWindow, count: int = OUTLINE_POINTS) -> Outline | None:
    """Points spaced evenly along all outlines of the silhouette, holes included."""
    mask = window.mask
    if mask is None:
        return None
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    contours = [c for c in contours if len(c) >= MIN_OUTLINE_LENGTH]
    if not contours:
        return NO_OUTLINE
    most = count + 4 * len(contours)
    found = Outline(np.empty((most, 2)), np.empty((most, 2)), np.empty(most))
    used = sample_outline(
        np.concatenate(contours)[:, 0],
        np.cumsum([len(c) for c in contours]),
        mask,
        NO_MASK if window.unsure is None else window.unsure,
        NO_MASK if window.others is None else window.others,
        count,
        window.left,
        window.top,
        *found,
    )
    return Outline(*(x[:used] for x in found))


NO_OUTLINE = Outline(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def _coverage_inputs(term: Weighting, evidence: Any) -> CoverageInputs:
    found: Outline = evidence or NO_OUTLINE
    samples = len(found.pixels)
    if samples == 0:
        term = term._replace(weight=0.0)
    return CoverageInputs(term, found, np.full((1, samples), np.inf), np.zeros((0, samples)))


COVERAGE = ImageTerm(
    'coverage',
    "Distance of the silhouette's outline from the model's contour.",
    TermSettings(30.0, 1.5, 8.0),
    outline,
    _coverage_inputs,
    needs_contour=True,
)
