"""Edges: visible contour points lie on image edges of the same direction (KJS 2).

    E(x) = w / V sum_i rho(d_o(i)(u_i(x)) / sigma)

over the V visible contour points u_i; d_o is the distance to the nearest edge of orientation o.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np

from hmt_ros import core
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.terms.image_term import (
    NO_MAP,
    NO_MASK,
    ImageTerm,
    ImageWindow,
    TermSettings,
    Weighting,
)

ORIENTATIONS: int = core.ORIENTATIONS
# Canny's thresholds.
CANNY_LOW, CANNY_HIGH = 40.0, 100.0
# Distance outside the silhouette beyond which edges belong to the background, px.
MARGIN = 4
_DISC = np.array(
    [
        [x * x + y * y <= (MARGIN + 0.5) ** 2 for x in range(-MARGIN, MARGIN + 1)]
        for y in range(-MARGIN, MARGIN + 1)
    ],
    dtype=np.uint8,
)
# Assumed distance to an edge at pixels where another person hides the edges, px.
HIDDEN_EDGE_DISTANCE = 2.0


class EdgeInputs(NamedTuple):
    """Inputs of `core/terms/edges.h`: distances to the nearest edge of each orientation, px."""

    term: Weighting
    distances: ImageMap


def edge_distances(window: ImageWindow) -> ImageMap:
    """Distance to the nearest edge, px, for each bin of the orientation of the edge's normal."""
    grey = cv2.cvtColor(window.image, cv2.COLOR_BGR2GRAY)
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    dx = cv2.Sobel(grey, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(grey, cv2.CV_16S, 0, 1)
    edges = cv2.Canny(dx, dy, CANNY_LOW, CANNY_HIGH)
    near = NO_MASK if window.widest is None else cv2.dilate(window.widest, _DISC)
    others = NO_MASK if window.others is None else window.others
    result = np.empty((ORIENTATIONS, *grey.shape), dtype=np.float32)
    core.edge_distances(edges, dx, dy, near, others, HIDDEN_EDGE_DISTANCE, result)
    return window.as_map(result)


def _inputs(term: Weighting, evidence: Any) -> EdgeInputs:
    return EdgeInputs(term, evidence or NO_MAP)


EDGES = ImageTerm(
    'edges',
    'Distance of the visible contours from image edges.',
    TermSettings(20.0, 1.5, 3.0),
    edge_distances,
    _inputs,
    needs_contour=True,
)
