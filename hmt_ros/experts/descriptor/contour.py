"""The person in a mask, and points at equal distances along the outline (BME 3).

A mask may show more than the person: other people, ghosts, or pieces separated by background
subtraction. One blob is taken as the person, together with the pieces that belong to it; other
blobs are counted so that callers can report them. The result also indicates the sides at which the
border of the image cuts the person.

`centred_view` renders the silhouette in a view without distortion, centred on the person. Near the
border of an image, especially with a wide-angle lens, a person appears stretched and leaning. In
the centred view, a posture looks the same at all places in the image, and its target
(`hmt_ros.experts.pose_encoding`) is the same, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.camera import Camera
from hmt_ros.core import elementary
from hmt_ros.experts.pose_encoding import ray_rotations
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.inference.linear_algebra import product

Bytes = NDArray[np.uint8]

MIN_AREA = 60  # minimum area of a person, px
# Maximum ratio of the sides of a person's bounding box, and maximum share of the box that a person
# fills.
MAX_SIDE_RATIO = 5.0
MAX_FILLED_FRACTION = 0.93
# Maximum area of a piece relative to the main blob; maximum gap relative to its longer side.
MAX_PIECE_AREA = 0.35
MAX_GAP = 0.12
NOTABLE_AREA = 0.02  # share of the person's area above which a left-out blob is reported
MIN_HOLE_AREA = 0.004  # share of the area below which a hole is noise
SMOOTHED_POINTS = (
    5  # number of averaged points of an outline, to remove the steps of the pixel grid
)
SIDES = ('left', 'top', 'right', 'bottom')

VIEW_SIDE = 192  # side length of the view, px
FILLED_FRACTION = 0.8  # approximate ratio of the longer side of the person to the side of the view
UPRIGHT_FRAME = np.eye(3)
MAX_STRAIGHT_ANGLE = np.radians(
    2.0
)  # angle to the optical axis below which the view is not rotated


class NoSilhouetteError(ValueError):
    """Raised for a mask without a person."""


@dataclass(frozen=True, eq=False)
class PersonBlob:
    """The part of a mask that is taken as the person.

    Attributes:
        mask: (h, w) uint8, 1 inside; cropped to the bounding box.
        left, top: Corner of the bounding box in the image, px.
        cut: Whether the border of the image cuts the person: left, top, right, bottom. At such a
            side the person extends beyond the box.
        left_out: Number of other blobs that are large enough to report.
    """

    mask: Bytes
    left: int
    top: int
    cut: tuple[bool, bool, bool, bool]
    left_out: int

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Left, top, right and bottom edge, px; half a pixel beyond the outer pixel centres."""
        height, width = self.mask.shape
        return self.left - 0.5, self.top - 0.5, self.left + width - 0.5, self.top + height - 0.5

    @property
    def remarks(self) -> tuple[str, ...]:
        """Remarks for a user: other blobs, and sides at which the person is cut."""
        result = []
        if self.left_out:
            result.append(
                f'{self.left_out} other blob{"s" if self.left_out > 1 else ""} left out: the '
                'largest that looks like a person is used'
            )
        if any(self.cut):
            sides = [side for side, cut in zip(SIDES, self.cut, strict=True) if cut]
            result.append(f'the person is cut by the border of the image ({", ".join(sides)})')
        return tuple(result)


def person_blob(mask: ArrayLike) -> PersonBlob:
    """Find the largest blob that looks like a person in a mask, with the pieces that belong to it.

    Args:
        mask: (H, W) nonzero in the foreground.

    Raises:
        NoSilhouetteError: the mask is empty or has only specks.
        ValueError: the array is not a mask.
    """
    array = np.asarray(mask)
    if array.ndim != 2:
        raise ValueError(f'a mask has two axes (H, W), saw an array of shape {array.shape}')
    height, width = array.shape
    seen = np.ascontiguousarray(array != 0).view(np.uint8)
    x, y, w, h = cv2.boundingRect(seen)
    if w == 0:
        raise NoSilhouetteError('the silhouette is empty: nobody is seen')
    part = seen[y : y + h, x : x + w]
    count, labels, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=8)
    area = stats[1:, cv2.CC_STAT_AREA]
    if area.max() < MIN_AREA:
        raise NoSilhouetteError(
            f'the largest blob of the silhouette has {area.max()} px, wanted {MIN_AREA} at least'
        )
    left_out = 0
    if count > 2:
        kept, left_out = _belonging(np.asarray(stats[1:], dtype=np.int32))
        part = np.concatenate([[False], kept])[labels].astype(np.uint8)
        dx, dy, w, h = cv2.boundingRect(part)
        part, x, y = np.ascontiguousarray(part[dy : dy + h, dx : dx + w]), x + dx, y + dy
    cut = (x == 0, y == 0, x + w == width, y + h == height)
    return PersonBlob(part, x, y, cut, left_out)


def _belonging(stats: NDArray[np.int32]) -> tuple[Mask, int]:
    """Mask (n,) of the blobs that belong to the person, and the number of other large blobs."""
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    width, height = (stats[:, i].astype(float) for i in (cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT))
    like = np.maximum(width / height, height / width) <= MAX_SIDE_RATIO
    like &= area < MAX_FILLED_FRACTION * width * height
    like &= area >= MIN_AREA
    main = int(np.argmax(np.where(like, area, -1.0) if like.any() else area))
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    apart_x = np.maximum(left - (left + width)[main], left[main] - (left + width))
    apart_y = np.maximum(top - (top + height)[main], top[main] - (top + height))
    near = np.maximum(apart_x, apart_y) < MAX_GAP * max(height[main], width[main])
    kept = near & (area < MAX_PIECE_AREA * area[main])
    kept[main] = True
    return kept, int(np.count_nonzero(~kept & (area >= NOTABLE_AREA * area[main])))


def sample_contour(mask: Bytes, count: int = 100) -> tuple[Array, Array]:
    """Points at equal distances along the outlines of a mask, and the directions of the outlines.

    The outer outlines of all pieces and the outlines of holes get points in proportion to their
    lengths. The inside is on the same side of all outlines.

    Args:
        mask: (h, w) uint8, 1 inside.

    Returns:
        points (count, 2), px, and directions (count,), rad.

    Raises:
        NoSilhouetteError: no outline is long enough.
    """
    bordered = cv2.copyMakeBorder(mask, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    found, tree = cv2.findContours(bordered, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    area = np.count_nonzero(mask)
    outlines = []
    for outline, (_, _, _, parent) in zip(found, tree[0] if tree is not None else ()):
        if len(outline) < 12:
            continue
        if parent >= 0 and cv2.contourArea(outline) < MIN_HOLE_AREA * area:
            continue
        outlines.append(_smooth(outline[:, 0].astype(np.float64) - 1.0))
    if not outlines:
        raise NoSilhouetteError('the silhouette has no outline')
    steps = [np.linalg.norm(np.roll(x, -1, axis=0) - x, axis=1) for x in outlines]
    lengths = np.array([x.sum() for x in steps])
    # Positions of the points along all outlines, joined end to end.
    at = (np.arange(count) + 0.5) / count * lengths.sum()
    ends = np.cumsum(lengths)
    points, directions = np.empty((count, 2)), np.empty(count)
    for outline, step, end, length in zip(outlines, steps, ends, lengths, strict=True):
        mine = (at >= end - length) & (at < end)
        if not mine.any():
            continue
        along = np.concatenate([[0.0], np.cumsum(step)])
        closed = np.concatenate([outline, outline[:1]])
        here = at[mine] - (end - length)
        points[mine] = np.stack([np.interp(here, along, closed[:, i]) for i in (0, 1)], axis=1)
        chord = 0.5 * length / len(outline) * SMOOTHED_POINTS
        ahead, behind = (
            np.stack([np.interp(s % length, along, closed[:, i]) for i in (0, 1)], axis=1)
            for s in (here + chord, here - chord)
        )
        directions[mine] = elementary.arctan2(*(ahead - behind).T[::-1])
    return points, directions


def _smooth(outline: Array) -> Array:
    total = outline.copy()
    for k in range(1, SMOOTHED_POINTS // 2 + 1):
        total += np.roll(outline, k, axis=0)
        total += np.roll(outline, -k, axis=0)
    return total / (2 * (SMOOTHED_POINTS // 2) + 1)


def centred_view(
    blob: PersonBlob, camera: Camera, level: Array = UPRIGHT_FRAME, grey: Bytes | None = None
) -> tuple[Bytes, Bytes | None]:
    """Mask (h, w) of the person, 1 inside, seen by the camera turned to the middle of the box.

    Args:
        blob: the person.
        camera: camera of the mask.
        level: (3, 3) rotation about the optical axis, from an upright camera's axes to the axes of
            `camera`.
        grey: (H, W) grey levels of the camera's image, or None.

    Returns:
        The mask of the person and the grey levels (h, w), both in the new view; None without
        `grey`.
    """
    if grey is not None:
        height, width = blob.mask.shape
        grey = grey[blob.top : blob.top + height, blob.left : blob.left + width]
    left, top, right, bottom = blob.box
    middle = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
    axis = camera.rays(middle)
    upright = np.array_equal(level, UPRIGHT_FRAME)
    if upright and not camera.distortion and axis[2] > elementary.cos(MAX_STRAIGHT_ANGLE):
        return blob.mask, grey
    corners = np.array([[x, y] for x in (left, middle[0], right) for y in (top, middle[1], bottom)])
    # Rotation from the view to the camera.
    turn = product(level, ray_rotations(product(axis[None], level))[0])
    seen = product(camera.rays(corners), turn)
    reach = float(np.abs(seen[:, :2] / np.maximum(seen[:, 2:], 0.1)).max())
    focal = 0.5 * FILLED_FRACTION * VIEW_SIDE / reach
    centre = 0.5 * (VIEW_SIDE - 1)
    across = (np.arange(VIEW_SIDE) - centre) / focal
    rays = np.array([x * across + y * across[:, None] + z for x, y, z in turn])
    pixels, _ = camera.project_with_derivative(rays, derivative=False)
    pixels = np.where(np.isfinite(pixels), pixels, -1e4).astype(np.float32)
    columns, rows = pixels[0] - np.float32(blob.left), pixels[1] - np.float32(blob.top)
    drawn = cv2.remap(blob.mask * np.uint8(255), columns, rows, cv2.INTER_LINEAR)
    result: Bytes = (drawn > 127).astype(np.uint8)
    if not result.any():
        return blob.mask, grey
    if grey is not None:
        border = cv2.BORDER_REPLICATE
        grey = np.asarray(
            cv2.remap(grey, columns, rows, cv2.INTER_LINEAR, borderMode=border), np.uint8
        )
    return result, grey
