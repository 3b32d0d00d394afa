"""Where people are in an image: what each covers is unknown to the others.

Of two people the nearer one hides the farther one. To the farther one all that the nearer one
covers is unknown; to the nearer one only what the farther one covers beside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.tracking.association import Sighting

# Margin around what a person covers, or around the hull of keypoints, that is unknown to others, as
# a fraction of the height: the radius of a limb.
MARGIN = 0.05


def unknown_area(mine: Mask, nearer: Sequence[Mask], farther: Sequence[Mask]) -> Mask | None:
    """Pixels (H, W) that do not tell of a person; None: there are none.

    Args:
        mine: (H, W) that the person covers.
        nearer, farther: what those cover who are before and behind the person.
    """
    result = np.zeros_like(mine)
    for area in nearer:
        result |= area
    for area in farther:
        result |= area & ~mine
    return result if result.any() else None


def hull(sighting: Sighting, shape: tuple[int, ...]) -> Mask:
    """Pixels (H, W) within the joints of somebody, or within the box, with a margin."""
    joints = np.array(list(sighting.joints.values()))
    if len(joints) < 3:
        (left, top), (right, bottom) = sighting.corners.tolist()
        joints = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    limit = 4.0 * max(shape)
    points = np.clip(joints, -limit, limit).round().astype(np.int32)
    mask = np.zeros(shape[:2], dtype=np.uint8)
    cv2.fillConvexPoly(mask, cv2.convexHull(points), 1)
    return grown(mask.view(np.bool_))


def grown(area: Mask) -> Mask:
    """An area (H, W) with a margin."""
    pixels = area.view(np.uint8)
    size = max(round(MARGIN * cv2.boundingRect(pixels)[3]), 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size + 1, 2 * size + 1))
    return np.asarray(cv2.dilate(pixels, kernel), dtype=np.uint8) > 0


def moved(area: Mask, shift: Array) -> Mask:
    """An area (H, W) moved by a shift (2,) of whole pixels."""
    height, width = area.shape
    dx, dy = (int(x) for x in np.clip(np.rint(shift), -max(area.shape), max(area.shape)))
    result = np.zeros_like(area)
    if abs(dx) < width and abs(dy) < height:
        rows = slice(max(dy, 0), height + min(dy, 0)), slice(max(-dy, 0), height + min(-dy, 0))
        columns = slice(max(dx, 0), width + min(dx, 0)), slice(max(-dx, 0), width + min(-dx, 0))
        result[rows[0], columns[0]] = area[rows[1], columns[1]]
    return result
