"""Area of a person in an image, and pieces of a silhouette that have the shape of a person."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.kinematics import point_positions
from hmt_ros.image.background import BackgroundSettings, of_one_person, pieces_of
from hmt_ros.image.surface_points import coarse_mesh
from hmt_ros.inference.arrays import Array, Mask

# Approximate height of the coarse raster for areas and colours, px.
RASTER_HEIGHT = 240
# Minimum length of a person's silhouette, px; minimum area as a fraction of the squared length, to
# exclude lines; maximum area as a fraction of the bounding box, to exclude rectangles.
MIN_LENGTH = 40
MIN_FILLED, MAX_FILLED = 0.04, 0.9


class Piece(NamedTuple):
    """A piece of a silhouette that has the shape of one person.

    Attributes:
        area: area of the piece, px of the full image.
        cut: whether the piece touches the left or right border of the image, which may cut it.
    """

    area: float
    cut: bool


def raster_step(height: int) -> int:
    """Step of the coarse raster, px, for an image of this height."""
    return max(round(height / RASTER_HEIGHT), 1)


def on_raster(image: NDArray[Any], raster: Mask) -> NDArray[Any]:
    """An image (H, W, ...) at the pixels of a coarser raster (h, w)."""
    size = raster.shape[::-1]
    seen = image.view(np.uint8) if image.dtype == np.bool_ else image
    return np.asarray(cv2.resize(seen, size, interpolation=cv2.INTER_NEAREST)).view(image.dtype)


def largest_person(foreground: Mask, step: int = 1) -> Piece | None:
    """The largest piece of a foreground that has the shape of one person; None if missing.

    A piece is either connected, or the largest piece together with nearby pieces, because clothes
    in the colours of the room leave gaps.

    Args:
        foreground: (h, w) mask.
        step: distance in the image between neighbouring pixels of the mask, px.
    """
    x, y, across, down = cv2.boundingRect(foreground.view(np.uint8))
    if across == 0:
        return None
    # Most of an image is empty.
    _, stats = pieces_of(foreground[y : y + down, x : x + across])
    parts = stats[of_one_person(stats, BackgroundSettings())]
    corner = parts[:, :2].min(0)
    size = (parts[:, :2] + parts[:, 2:4]).max(0) - corner
    boxes = [*stats[1:].tolist(), [*corner.tolist(), *size.tolist(), int(parts[:, 4].sum())]]
    alike = [
        Piece(float(step**2 * area), x + left == 0 or x + left + width == foreground.shape[1])
        for left, _, width, height, area in boxes
        if _is_person(width, height, area, step)
    ]
    return max(alike, default=None)


def _is_person(width: int, height: int, area: int, step: int) -> bool:
    length = max(width, height)
    return (
        step * length >= MIN_LENGTH
        and area >= MIN_FILLED * length**2
        and area <= MAX_FILLED * width * height
    )


def looks_like_person(silhouette: Mask) -> bool:
    """Whether a silhouette (H, W) has the size and shape of one person."""
    _, _, width, height = cv2.boundingRect(silhouette.view(np.uint8))
    return _is_person(width, height, counted(silhouette), 1)


def covered(body: Body, camera: Camera, pose: Array, step: int = 1) -> Mask:
    """Mask (H / step, W / step) of every step-th pixel: whether a body in a pose (d,) covers it.

    Each part of the flesh is drawn as the convex hull of its projected points.
    """
    mesh, parts = coarse_mesh(body), len(body.flesh.parts)
    places = point_positions(body.skeleton, pose[None], mesh.segments, mesh.vertices)
    corners = len(mesh.vertices) // max(parts, 1)
    pixels = camera.project(places.reshape(parts, corners, 3)) / step
    mask = np.zeros((-(-camera.height // step), -(-camera.width // step)), dtype=np.uint8)
    # Skip parts that are partly behind the camera.
    for hull in map(cv2.convexHull, _corners(mask, pixels[np.isfinite(pixels).all((1, 2))])):
        cv2.fillConvexPoly(mask, hull, 1)
    return mask.view(np.bool_)


def fill_hull(mask: NDArray[np.uint8], pixels: Array) -> None:
    """Sets a mask (H, W) to 1 in the convex hull of points (N, 2), px."""
    cv2.fillConvexPoly(mask, cv2.convexHull(_corners(mask, pixels)), 1)


def _corners(mask: NDArray[np.uint8], pixels: Array) -> NDArray[np.int32]:
    """Integer points (..., 2) for OpenCV, clipped far outside the image to avoid overflow."""
    limit = 4.0 * max(mask.shape)
    return np.rint(np.clip(pixels, -limit, limit)).astype(np.int32)


def counted(mask: Mask) -> int:
    """Number of pixels in a mask."""
    return cv2.countNonZero(mask.view(np.uint8))


def resized(area: Mask, margin: float) -> Mask:
    """An area (H, W) grown by a fraction of its height, or shrunk if the fraction is negative."""
    pixels = area.view(np.uint8)
    size = max(round(abs(margin) * cv2.boundingRect(pixels)[3]), 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * size + 1, 2 * size + 1))
    change = cv2.dilate if margin > 0 else cv2.erode
    return np.asarray(change(pixels, kernel), dtype=np.uint8) > 0
