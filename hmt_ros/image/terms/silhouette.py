"""The silhouette (KJS 2; Sminchisescu and Triggs, IJRR 2003).

    coverage      E(x) = w / M sum_m rho(|u_i(m)(x) - s_m| / sigma)

s_m are M samples of the outline of the silhouette, u_i points of the model's contour, and i(m) is
the one nearest to sample m. The model explains the silhouette when its outline lies on the contour
of the model.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from hmt_ros.image.terms.image_term import (
    ImageTerm,
    ImageWindow,
    Request,
    TermSettings,
    Weighting,
)
from hmt_ros.inference.arrays import Array

# Samples on the outline.
OUTLINE_POINTS = 120
# Belief in a sample of the outline beyond which, this many px away, the person may go on.
UNSURE = 0.3
BESIDE = 4.0


class Outline(NamedTuple):
    """M samples on the outline of a silhouette.

    Attributes:
        pixels: (M, 2).
        normals: (M, 2) unit vectors out of the silhouette.
        beliefs: (M,) belief in each, 0 to 1.
    """

    pixels: Array
    normals: Array
    beliefs: Array


class CoverageInputs(NamedTuple):
    """Inputs of `core/terms/coverage.h`.

    Attributes:
        term: weighting.
        outline: samples.
        explained: (X, M) maximum energy of samples; a row a pose, or one row for all.
        costs: (N, M) result: energy of each sample.
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
    contours = [c[:, 0].astype(float) for c in contours if len(c) >= 12]
    if not contours:
        return NO_OUTLINE
    steps = [np.linalg.norm(np.roll(c, -1, axis=0) - c, axis=1) for c in contours]
    total = sum(x.sum() for x in steps)
    points = []
    for contour, step in zip(contours, steps, strict=True):
        n = max(round(count * step.sum() / total), 3)
        along = np.concatenate([[0.0], np.cumsum(step)])
        closed = np.concatenate([contour, contour[:1]])
        at = (np.arange(n) + 0.5) / n * along[-1]
        points.append(np.stack([np.interp(at, along, closed[:, i]) for i in range(2)], axis=1))
    pixels = np.concatenate(points)
    # Out of the silhouette is against the gradient of the blurred mask.
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 2.0)
    column, row = np.round(pixels).astype(int).T
    normals = -np.stack(
        [
            cv2.Sobel(blurred, cv2.CV_32F, 1, 0)[row, column],
            cv2.Sobel(blurred, cv2.CV_32F, 0, 1)[row, column],
        ],
        axis=1,
    ).astype(float)
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-3
    normals = normals[good] / length[good, None]
    # The outline lies half a pixel outside the last pixels of the silhouette.
    pixels = pixels[good]
    beliefs = np.ones(len(pixels))
    if window.unsure is not None or window.others is not None:
        column, row = np.round(pixels + BESIDE * normals).astype(int).T
        column = np.clip(column, 0, mask.shape[1] - 1)
        row = np.clip(row, 0, mask.shape[0] - 1)
        if window.unsure is not None:
            beliefs[window.unsure[row, column] > 0] = UNSURE
        if window.others is not None:
            beliefs[window.others[row, column] > 0] = 0.0
    pixels = pixels + 0.5 * normals + np.array([window.left, window.top])
    return Outline(pixels, normals, beliefs)


NO_OUTLINE = Outline(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


def _coverage_inputs(term: Weighting, evidence: Any, request: Request) -> CoverageInputs:
    found: Outline = evidence or NO_OUTLINE
    samples = len(found.pixels)
    if samples == 0:
        term = term._replace(weight=0.0)
    explained = request.explained
    if explained is None:
        explained = np.full((1, samples), np.inf)
    return CoverageInputs(term, found, explained, np.zeros((request.poses, samples)))


COVERAGE = ImageTerm(
    'coverage',
    "Distance of the silhouette's outline from the model's contour.",
    TermSettings(30.0, 1.5, 8.0),
    outline,
    _coverage_inputs,
    needs_contour=True,
)
