"""Edges inside a silhouette: faces, arms in front of the trunk, crossed legs (BME 3).

    h(cell, angle, s) = sum |grad (G_s * I)| s / contrast     over pixels inside the eroded mask

Cells form a grid around the centroid, angles are unsigned, and the scales s are larger than cloth
patterns. Smoothing uses pixels of the person only, so that the outline makes no edge;
contrast is the range of the person's grey levels. An outline does not show whether a person faces
the camera, or whether an arm is in front of the trunk or behind; edges inside it do.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array

Bytes = NDArray[np.uint8]

CELLS, ANGLES = 8, 4
# Standard deviations of the smoothing, px, for a person of 128 px.
SCALES = (1.5, 3.0)
EDGES = len(SCALES) * CELLS * CELLS * ANGLES
# Minimum distance of a pixel to the outline, px.
MIN_OUTLINE_DISTANCE = 3.0
# Minimum range of grey levels, from the 10th to the 90th percentile.
MIN_CONTRAST = 20.0


def internal_edges(grey: Bytes, mask: Bytes, centre: tuple[float, float], width: float) -> Array:
    """Square roots (EDGES,) of the edge histogram, by scale, row, column and angle.

    Args:
        grey: (h, w) grey levels.
        mask: (h, w) 1 on the person, at the size of `silhouette_descriptor.SIZE`.
        centre, width: middle and width of the grid, px.
    """
    inside = mask > 0
    bordered = cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    distances = cv2.distanceTransform(bordered, cv2.DIST_L2, 3)[1:-1, 1:-1]
    rows, columns = np.nonzero(distances > MIN_OUTLINE_DISTANCE)
    result = np.zeros((len(SCALES), CELLS * CELLS * ANGLES))
    if not len(rows):
        return result.ravel()
    low, high = np.percentile(grey[inside], (10, 90))
    contrast = max(float(high - low), MIN_CONTRAST)
    across, down = (
        np.clip((at - middle) / width * CELLS + 0.5 * CELLS, 0, CELLS - 1).astype(np.intp)
        for at, middle in ((columns, centre[0]), (rows, centre[1]))
    )
    cells = (down * CELLS + across) * ANGLES
    # Integers, because OpenCV smooths them to the same bits on all machines.
    weights = np.where(inside, np.uint16(65535), np.uint16(0))
    values = np.where(inside, grey, np.uint8(0)).astype(np.uint16) * np.uint16(257)
    for own, scale in zip(result, SCALES, strict=True):
        sums, shares = (cv2.GaussianBlur(x, (0, 0), scale) for x in (values, weights))
        smooth = 255.0 * (sums / np.maximum(shares, np.uint16(1)))
        right, below = (
            0.5 * (smooth[rows + y, columns + x] - smooth[rows - y, columns - x])
            for x, y in ((1, 0), (0, 1))
        )
        size = np.sqrt(right * right + below * below) * (scale / contrast)
        angle = elementary.arctan2(below, right) % np.pi * (ANGLES / np.pi)
        first = np.floor(angle)
        share = angle - first
        for which, part in ((first, 1.0 - share), (first + 1.0, share)):
            bins = cells + which.astype(np.intp) % ANGLES
            own += np.bincount(bins, size * part, own.size)
    # Divide by the number of pixels in a quarter of a cell.
    return np.sqrt(result.ravel() * (4.0 * CELLS * CELLS) / (width * width))
