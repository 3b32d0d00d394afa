"""The descriptor of a silhouette: the vector from which a pose is predicted (BME 3).

It combines five descriptions of the silhouette, which is first resized to a standard size:

- the histogram of shape contexts over a codebook: which local shapes occur;
- the histogram of edge pairs across the inside: how thick and how bent limbs are;
- a map of the signed distance to the outline: where limbs are;
- moments and proportions of the whole;
- edges inside, if there is an image (`internal_edges`). Without an image the descriptor uses the
  mean of these features.

All are invariant to the position and the size of the person in the image. Edge pairs are also
invariant to rotation; the other descriptions are not, because cameras are usually upright. A
silhouette and its mirror image have different descriptors. The parts are weighted and projected
onto the principal components of the training silhouettes.

The shape context of a point is the histogram of the positions of the other points relative to it: 5
radial bins on a log scale from 1/8 to 3 of the mean distance, and 12 angular bins. K-means over all
contexts of a training set gives a codebook. A silhouette is described by a histogram: each of its
contexts votes for the nearest centres, weighted by inverse distance.

Two points form an edge pair if the line between them lies inside the silhouette: points on the two
sides of a limb or of the trunk, or at the two ends of a straight part. The histogram of the
distances and angles of edge pairs shows how thick and how bent limbs are, wherever they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.learned_file import require
from hmt_ros.core import elementary
from hmt_ros.experts.descriptor.contour import person_blob, sample_contour
from hmt_ros.experts.descriptor.internal_edges import EDGES, internal_edges
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.clustering import smallest_columns, squared_distances
from hmt_ros.inference.linear_algebra import product

Bytes = NDArray[np.uint8]

RADIAL_BINS, ANGULAR_BINS = 5, 12
RADII = (1 / 8, 3.0)  # smallest and largest radius, in mean distances between points
VOTES_PER_CONTEXT = 4  # number of centres that a context votes for
MIN_DISTANCE = 1e-3  # lower bound of the distance in the weight of a vote

PAIR_DISTANCES, PAIR_ANGLES = 6, 8
PAIR_BINS = PAIR_DISTANCES * PAIR_ANGLES
CONNECTION_POSITIONS = (0.5, 0.25, 0.75)  # positions along a connection that must lie inside


def shape_contexts(points: Array) -> Array:
    """Shape contexts (N, 60) of points (N, 2): the share of the other points in each bin.

    They are invariant to translation and scale, but not to rotation. Points below the smallest and
    above the largest radius fall into no bin.
    """
    n = len(points)
    off = points[None] - points[:, None]  # (N, N, 2)
    distance = np.sqrt(off[..., 0] ** 2 + off[..., 1] ** 2)
    mean = distance.sum() / max(n * (n - 1), 1)
    low, high = RADII
    with np.errstate(divide='ignore'):
        radial = elementary.log(distance / (mean * low)) * (
            RADIAL_BINS / elementary.log(high / low)
        )
    ring = np.floor(np.maximum(radial, -1.0)).astype(np.intp)
    angle = elementary.arctan2(off[..., 1], off[..., 0]) * (ANGULAR_BINS / (2 * np.pi))
    sector = np.floor(angle).astype(np.intp) % ANGULAR_BINS
    inside = (ring >= 0) & (ring < RADIAL_BINS)
    bins = np.arange(n)[:, None] * (RADIAL_BINS * ANGULAR_BINS) + ring * ANGULAR_BINS + sector
    counts = np.bincount(bins[inside], minlength=n * RADIAL_BINS * ANGULAR_BINS)
    return counts.reshape(n, RADIAL_BINS * ANGULAR_BINS) / max(n - 1, 1)


@dataclass(frozen=True, eq=False)
class ShapeContextCodebook:
    """Centres (C, 60) of the square roots of shape contexts.

    Distances between square roots of shares are Hellinger distances, which the fullest bins do not
    dominate.

    Raises:
        ValueError: the centres have a wrong shape or are not finite.
    """

    centres: Array

    def __post_init__(self) -> None:
        shape = self.centres.shape
        require(
            shape[1:] == (RADIAL_BINS * ANGULAR_BINS,) and np.isfinite(self.centres).all(),
            f'centres of shape contexts must be finite and (C, {RADIAL_BINS * ANGULAR_BINS}), '
            f'saw {shape}',
        )

    def histogram(self, contexts: Array) -> Array:
        """Votes (C,) of contexts (N, 60): a histogram that sums to 1."""
        squared = squared_distances(np.sqrt(contexts), self.centres)
        votes = min(VOTES_PER_CONTEXT, len(self.centres))
        nearest = smallest_columns(squared, votes)
        distance = np.sqrt(np.take_along_axis(squared, nearest, axis=1))
        weight = 1.0 / np.maximum(distance, MIN_DISTANCE)
        weight /= weight.sum(1, keepdims=True)
        counts = np.bincount(nearest.ravel(), weight.ravel(), len(self.centres))
        return np.asarray(counts / len(contexts), dtype=np.float64)


def edge_pairs(points: Array, directions: Array, mask: Bytes) -> Array:
    """Histogram (48,) of the distances and angles of edge pairs; it sums to 1.

    It is invariant to translation, scale and rotation.

    Args:
        points: (N, 2) points on the outlines, px.
        directions: (N,) directions of the outlines at the points, rad.
        mask: (h, w) mask of the silhouette.
    """
    first, second = _pairs(len(points))
    start = points[first]
    off = points[second] - start
    distance = np.sqrt((off * off).sum(1))
    mean = max(float(distance.mean()), 1e-9)
    height, width = mask.shape
    inside = np.ones(len(off), dtype=bool)
    for share in CONNECTION_POSITIONS:  # smoothed outlines never leave the mask
        column, row = (start + share * off + 0.5).astype(np.int32).T
        inside &= mask[np.minimum(row, height - 1), np.minimum(column, width - 1)] > 0
    low, high = RADII
    scale = PAIR_DISTANCES / elementary.log(high / low)
    ring = elementary.log(np.maximum(distance[inside], 1e-9) / (mean * low)) * scale
    turn = np.abs((directions[second] - directions[first])[inside])
    turn = np.minimum(turn % (2 * np.pi), -turn % (2 * np.pi))  # 0 to pi
    bins = np.clip(ring, 0, PAIR_DISTANCES - 1).astype(np.intp) * PAIR_ANGLES
    bins += np.minimum(turn * (PAIR_ANGLES / np.pi), PAIR_ANGLES - 1).astype(np.intp)
    counts: Array = np.bincount(bins, minlength=PAIR_BINS).astype(np.float64)
    return counts / max(float(counts.sum()), 1.0)


@lru_cache(maxsize=4)
def _pairs(count: int) -> tuple[Index, Index]:
    first, second = np.triu_indices(count, 1)
    return first, second


SIZE = 128  # longer side of the resized person, px
MAP_SIDE = 16  # number of cells per side of the map of distances
MAP_EXTENT = 4.4  # width of the map in radii of gyration, enough for stretched arms and legs
MAX_INNER_DISTANCE, MAX_OUTER_DISTANCE = (
    0.25,
    0.60,
)  # limits of the distances inside and outside, radii of gyration
MOMENTS = 12
FIXED_FEATURES = (
    PAIR_BINS + MAP_SIDE * MAP_SIDE + MOMENTS + EDGES
)  # number of features other than shape contexts
MIN_POINTS, MAX_POINTS = 8, 500  # of the outline; the cost is quadratic in the points


@dataclass(frozen=True, eq=False)
class SilhouetteParts:
    """The descriptions of one silhouette before they are weighted.

    Attributes:
        contexts: (n, 60) shape contexts of the points of the outline.
        edge_pairs: (48,) histogram.
        distances: (MAP_SIDE * MAP_SIDE,) signed distances to the outline, positive inside, in radii
            of gyration.
        moments: (12,) second and third moments, proportions.
        edges: (EDGES,) see `internal_edges`; NaN: unknown.
    """

    contexts: Array
    edge_pairs: Array
    distances: Array
    moments: Array
    edges: Array


def silhouette_parts(
    mask: ArrayLike, points: int = 100, grey: Bytes | None = None
) -> SilhouetteParts:
    """Compute the descriptions of the person in a mask (H, W).

    Args:
        mask: (H, W) nonzero in the foreground.
        grey: (H, W) grey levels of the image; None: edges inside are unknown.

    Raises:
        NoSilhouetteError: the mask has no person.
    """
    blob = person_blob(mask)
    person = _at_one_size(blob.mask)
    outline, directions = sample_contour(person, points)
    distances, moments, centre, width = _map_and_moments(person)
    edges = np.full(EDGES, np.nan)
    if grey is not None:
        height, across = blob.mask.shape
        own = grey[blob.top : blob.top + height, blob.left : blob.left + across]
        resized = cv2.resize(own, person.shape[::-1], interpolation=_interpolation(blob.mask))
        edges = internal_edges(np.asarray(resized, np.uint8), person, centre, width)
    pairs = edge_pairs(outline, directions, person)
    return SilhouetteParts(shape_contexts(outline), pairs, distances, moments, edges)


@dataclass(frozen=True, eq=False)
class SilhouetteDescriptor:
    """Descriptor learned by `hmt_learning.training.descriptor_learning`.

    Attributes:
        codebook: Codebook of shape contexts.
        scale: (q,) weights of the parts.
        centre: (q,) mean of the weighted parts.
        basis: (q, p) principal directions, scaled.
        points: Number of points on the outline.

    Raises:
        ValueError: arrays have wrong shapes or are not finite.
    """

    codebook: ShapeContextCodebook
    scale: Array
    centre: Array
    basis: Array
    points: int = 100

    def __post_init__(self) -> None:
        for name in ('scale', 'centre', 'basis'):
            finite = np.isfinite(getattr(self, name)).all()
            require(finite, f'{name} of the descriptor must be finite')
        length = len(self.codebook.centres) + FIXED_FEATURES
        shapes = (self.scale.shape, self.centre.shape, self.basis.shape[:1])
        require(
            shapes == ((length,),) * 3 and self.basis.ndim == 2,
            f'arrays of the descriptor have shapes {shapes}, wanted ({length},)',
        )
        right = type(self.points) is int and MIN_POINTS <= self.points <= MAX_POINTS
        require(right, f'wanted {MIN_POINTS} to {MAX_POINTS} points on the outline')

    @property
    def size(self) -> int:
        """Length of a descriptor, p."""
        return int(self.basis.shape[1])

    def describe(self, parts: Iterable[SilhouetteParts]) -> Array:
        """Descriptors (n, p) of silhouettes."""
        features = [np.concatenate([*features_of(self.codebook, x).values()]) for x in parts]
        off = np.array(features) * self.scale - self.centre
        return np.asarray(product(np.where(np.isnan(off), 0.0, off), self.basis))

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """The learned arrays in single precision, for a file."""
        return {
            'codebook': self.codebook.centres.astype(np.float32),
            'scale': self.scale.astype(np.float32),
            'centre': self.centre.astype(np.float32),
            'basis': self.basis.astype(np.float32),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], points: int) -> SilhouetteDescriptor:
        """The descriptor that `to_arrays` stored.

        Raises:
            ValueError, KeyError: arrays are missing or do not fit.
        """
        codebook, scale, centre, basis = (
            np.asarray(arrays[name], dtype=np.float64)
            for name in ('codebook', 'scale', 'centre', 'basis')
        )
        return cls(ShapeContextCodebook(codebook), scale, centre, basis, points)


def features_of(codebook: ShapeContextCodebook, parts: SilhouetteParts) -> dict[str, Array]:
    """The unweighted features of a silhouette, by part."""
    # Square roots of shares, as in the codebook.
    return {
        'shape_contexts': np.sqrt(codebook.histogram(parts.contexts)),
        'edge_pairs': np.sqrt(parts.edge_pairs),
        'distances': parts.distances,
        'moments': parts.moments,
        'edges': parts.edges,
    }


def _at_one_size(mask: Bytes) -> Bytes:
    """Resize the person so that the longer side has SIZE pixels."""
    factor = SIZE / max(mask.shape)
    height, width = (max(round(side * factor), 3) for side in mask.shape)
    resized = cv2.resize(mask * np.uint8(255), (width, height), interpolation=_interpolation(mask))
    return (resized > 127).astype(np.uint8)


def _interpolation(mask: Bytes) -> int:
    return cv2.INTER_AREA if max(mask.shape) > SIZE else cv2.INTER_LINEAR


def _interpolated(values: Array, rows: Array, columns: Array) -> Array:
    """Interpolate values (h, w) bilinearly at rows (m,) and columns (n,); return (m, n)."""
    i = np.clip(np.floor(rows).astype(np.intp), 0, values.shape[0] - 2)
    j = np.clip(np.floor(columns).astype(np.intp), 0, values.shape[1] - 2)
    down, right = (rows - i)[:, None], columns - j
    upper = values[i] * (1.0 - down) + values[i + 1] * down
    return np.asarray(upper[:, j] * (1.0 - right) + upper[:, j + 1] * right)


def _map_and_moments(mask: Bytes) -> tuple[Array, Array, tuple[float, float], float]:
    """Signed distances (MAP_SIDE^2,) around the centroid, moments, centroid and width."""
    m = cv2.moments(mask, binaryImage=True)
    area = m['m00']
    x, y = m['m10'] / area, m['m01'] / area
    radius = np.sqrt((m['mu20'] + m['mu02']) / area)
    half = 0.5 * MAP_EXTENT * radius
    # Pad the mask to hold the whole map.
    height, width = mask.shape
    left, top = (max(int(half - at) + 2, 2) for at in (x, y))
    right, bottom = (max(int(at + half) - side + 3, 2) for at, side in ((x, width), (y, height)))
    wide = cv2.copyMakeBorder(mask, top, bottom, left, right, cv2.BORDER_CONSTANT, value=0)
    inside = cv2.distanceTransform(wide, cv2.DIST_L2, 3)
    outside = cv2.distanceTransform(1 - wide, cv2.DIST_L2, 3)
    distance = np.clip((inside - outside) / radius, -MAX_OUTER_DISTANCE, MAX_INNER_DISTANCE)
    scale = MAP_SIDE / (2 * half)
    steps = (np.arange(MAP_SIDE) - (0.5 * MAP_SIDE - 0.5)) / scale
    cells = _interpolated(distance, y + top + steps, x + left + steps)
    second = np.array([m['mu20'], m['mu02'], m['mu11']]) / (area * radius**2)
    third = np.array([m['mu30'], m['mu21'], m['mu12'], m['mu03']]) / (
        area * (radius * radius * radius)
    )
    proportions = [
        0.25 * height / radius,
        0.25 * width / radius,
        (x - 0.5 * width) / radius,
        (y - 0.5 * height) / radius,
        0.5 * np.sqrt(area) / radius,
    ]
    moments = np.concatenate([second, third, proportions])
    return cells.ravel().astype(np.float64), moments, (x, y), 2 * half
