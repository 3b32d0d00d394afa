"""What one image says: silhouette, its outline and distances, edges, motion since the last one."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.sampling import ImageMap

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]

EDGE_ORIENTATIONS = 4


@dataclass(frozen=True)
class Keypoints:
    """Image positions of joints, from any 2D detector or by hand.

    Attributes:
        names: (n,) joints of the body.
        pixels: (n, 2); NaN where a joint was not seen.
        covariances: (n, 2, 2) px^2.
        confidences: (n,) 0 to 1.
    """

    names: tuple[str, ...]
    pixels: Array
    covariances: Array
    confidences: Array

    def __post_init__(self) -> None:
        n = len(self.names)
        shapes = (self.pixels.shape, self.covariances.shape, self.confidences.shape)
        if shapes != ((n, 2), (n, 2, 2), (n,)):
            raise ValueError(f'{n} keypoints with arrays of shapes {shapes}')


@dataclass(frozen=True)
class ObservationSettings:
    """How an image is turned into an observation.

    Attributes:
        outline_points: samples on the outline of the silhouette.
        edge_low, edge_high: Canny's thresholds.
        edge_margin: edges further outside the silhouette than this are the background's, px.
        margin: pixels around the silhouette that the maps cover.
        intensity_blur: standard deviation of the blur before intensities are compared, px.
    """

    outline_points: int = 120
    edge_low: float = 40.0
    edge_high: float = 100.0
    edge_margin: int = 4
    margin: int = 48
    intensity_blur: float = 1.5


@dataclass(frozen=True, eq=False)
class Outline:
    """Samples on the outline of the silhouette.

    Attributes:
        pixels: (M, 2).
        normals: (M, 2) unit vectors out of the silhouette.
    """

    pixels: Array
    normals: Array


@dataclass(frozen=True, eq=False)
class Observation:
    """An image and what was computed from it, once for all poses.

    Attributes:
        image: (H, W, 3) BGR, or None where only keypoints are known.
        silhouette: (H, W) foreground, or None: unknown.
        distance: signed distance to the outline, px, positive outside; None without silhouette.
        outline: samples on the outline; None without silhouette.
        edges: distance to the nearest edge of each orientation, px; None: not computed.
        intensity: (3 channels) blurred colours; None: not computed.
        flow: motion from the last image to this one, two channels, px; None: no last image.
        keypoints: joints seen in the image, or None.
    """

    image: Image | None = None
    silhouette: Mask | None = None
    distance: ImageMap | None = None
    outline: Outline | None = None
    edges: ImageMap | None = None
    intensity: ImageMap | None = None
    flow: ImageMap | None = None
    keypoints: Keypoints | None = None

    @property
    def box(self) -> tuple[int, int, int, int] | None:
        """Bounding box (left, top, right, bottom) of the silhouette, px."""
        return None if self.silhouette is None else _box(self.silhouette)

    @property
    def shows_shape(self) -> bool:
        """Whether there is more to compare a pose with than keypoints."""
        maps = (self.distance, self.edges, self.flow, self.intensity)
        return any(m is not None for m in maps)


def observe(
    image: Image,
    silhouette: Mask | None = None,
    keypoints: Keypoints | None = None,
    settings: ObservationSettings | None = None,
    window: tuple[int, int, int, int] | None = None,
    last_image: Image | None = None,
    wanted: Collection[str] = ('edges', 'intensity', 'flow'),
) -> Observation:
    """Everything that the likelihood asks of an image.

    Args:
        image: (H, W, 3) BGR uint8.
        silhouette: (H, W) foreground; None or empty: the silhouette is not used.
        keypoints: joints seen in the image.
        settings: how.
        window: (left, top, right, bottom) where the person is expected, for images without a
            silhouette; the whole image when None.
        last_image: the image before, of the same size, for the optical flow.
        wanted: which of 'edges', 'intensity' and 'flow' to compute; the silhouette always is.

    Raises:
        ValueError: shapes that contradict each other.
    """
    s = settings or ObservationSettings()
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f'image must be (H, W, 3) uint8, saw {image.shape} {image.dtype}')
    if silhouette is not None and silhouette.shape != image.shape[:2]:
        raise ValueError(f'silhouette {silhouette.shape} for an image {image.shape[:2]}')
    known = silhouette is not None and bool(silhouette.any())
    box = _box(silhouette) if known and silhouette is not None else window
    left, top, right, bottom = _grown(box, s.margin, image.shape)
    part = image[top:bottom, left:right]
    distance, outline, near = None, None, None
    if known and silhouette is not None:
        mask = np.ascontiguousarray(silhouette[top:bottom, left:right]).view(np.uint8)
        signed = _signed_distance(mask)
        distance = ImageMap(signed[None], left, top)
        outline = _outline(mask, left, top, s.outline_points)
        near = signed <= s.edge_margin
    edges, intensity, flow = None, None, None
    if 'edges' in wanted:
        edges = ImageMap(_edge_distances(part, near, s), left, top)
    if 'intensity' in wanted:
        blurred = cv2.GaussianBlur(part, (0, 0), s.intensity_blur).astype(np.float32)
        intensity = ImageMap(np.ascontiguousarray(blurred.transpose(2, 0, 1)), left, top)
    if 'flow' in wanted and last_image is not None:
        before = np.ascontiguousarray(last_image[top:bottom, left:right])
        flow = ImageMap(_optical_flow(before, np.ascontiguousarray(part)), left, top)
    return Observation(
        image, silhouette if known else None, distance, outline, edges, intensity, flow, keypoints
    )


def _box(mask: Mask) -> tuple[int, int, int, int]:
    x, y, w, h = cv2.boundingRect(mask.view(np.uint8))
    return x, y, x + w, y + h


def _grown(
    box: tuple[int, int, int, int] | None, margin: int, shape: tuple[int, ...]
) -> tuple[int, int, int, int]:
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


def _signed_distance(mask: Image) -> NDArray[np.float32]:
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 5)
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
    # The outline lies between the pixels: half a pixel from either side.
    result: NDArray[np.float32] = np.where(mask > 0, 0.5 - inside, outside - 0.5)
    return result


def _outline(mask: Image, left: int, top: int, count: int) -> Outline:
    """Points spaced evenly along all outlines of the silhouette, holes included."""
    contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    contours = [c[:, 0].astype(float) for c in contours if len(c) >= 12]
    if not contours:
        return Outline(np.empty((0, 2)), np.empty((0, 2)))
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
    return Outline(pixels[good] + 0.5 * normals + np.array([left, top]), normals)


def _edge_distances(
    part: Image, near: Mask | None, settings: ObservationSettings
) -> NDArray[np.float32]:
    """Distance to the nearest edge whose normal falls into each orientation bin, (C, h, w) px."""
    grey = cv2.cvtColor(part, cv2.COLOR_BGR2GRAY)
    grey = cv2.GaussianBlur(grey, (0, 0), 1.0)
    dx = cv2.Sobel(grey, cv2.CV_16S, 1, 0)
    dy = cv2.Sobel(grey, cv2.CV_16S, 0, 1)
    edges = cv2.Canny(dx, dy, settings.edge_low, settings.edge_high) > 0
    if near is not None:
        edges &= near
    rows, columns = np.nonzero(edges)
    angle = np.arctan2(dy[rows, columns], dx[rows, columns])
    result = np.empty((EDGE_ORIENTATIONS, *grey.shape), dtype=np.float32)
    for k in range(EDGE_ORIENTATIONS):
        free = np.ones(grey.shape, dtype=np.uint8)
        mine = _counts_for(angle, k)
        free[rows[mine], columns[mine]] = 0
        if mine.any():
            result[k] = cv2.distanceTransform(free, cv2.DIST_L2, 3)
        else:
            result[k] = 1e3
    return result


def _optical_flow(before: Image, after: Image) -> NDArray[np.float32]:
    """Dense optical flow (2, h, w) from one image to the next, px [Kroeger et al., ECCV 2016]."""
    grey = [cv2.cvtColor(x, cv2.COLOR_BGR2GRAY) for x in (before, after)]
    if min(grey[0].shape) < 32:
        return np.zeros((2, *grey[0].shape), np.float32)
    # The stubs do not know that there may be no flow to start from.
    method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow: NDArray[np.float32] = method.calc(grey[0], grey[1], None)
    return np.ascontiguousarray(flow.transpose(2, 0, 1))


def _counts_for(angle: Array, k: int) -> Mask:
    """Edges within three quarters of a bin of the direction of bin k."""
    width = np.pi / EDGE_ORIENTATIONS
    off = (angle - k * width + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    result: Mask = np.abs(off) <= 0.75 * width
    return result
