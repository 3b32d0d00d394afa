"""Soft prior against intersections of parts of the body (KJS 2).

The overlap of two parts is the sum of their radii minus the distance between their axes, both along
the shortest line between the axes. The penalty is quadratic in the overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.core import overlap_depths
from hmt_ros.inference.arrays import Array, Index

TOLERANCE = 0.02  # overlap without cost, m: flesh is soft, and ellipsoids are approximate


class _Axes(NamedTuple):
    """The parts as capsules with elliptic cross-sections, for compiled code.

    Attributes:
        segments: (B,) segments that carry the parts.
        centres: (B, 3) centres of the axes in the segments' frames, m.
        halves: (B,) half lengths of the axes, m.
        radii: (B, 3) radii along x, y and, for the caps, z, m.
        reaches: (B,) distances from the centre to the farthest point, m.
    """

    segments: NDArray[np.int64]
    centres: Array
    halves: Array
    radii: Array
    reaches: Array


class Overlaps(NamedTuple):
    """Parts, the Q pairs of parts that may overlap, and the variables that move them.

    Attributes:
        parts: parts of the body.
        first, second: (Q,) indices of the parts of each pair.
        dof_is_rotation, moves: (d,), (S, d) see `Skeleton`.
        sigma: overlap with energy 1/2, m.
        tolerance: overlap without cost, m.
    """

    parts: _Axes
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    dof_is_rotation: NDArray[np.bool_]
    moves: NDArray[np.bool_]
    sigma: float
    tolerance: float = TOLERANCE


@dataclass(frozen=True, eq=False)
class SelfIntersection:
    """The prior against intersections of parts of the body.

    Derivatives neglect the change of radii as elliptic cross-sections rotate.

    Attributes:
        body: the body; pairs of neighbours along the skeleton are left out.
        sigma: overlap with energy 1/2, m; inf switches the prior off.
    """

    body: Body
    sigma: float

    @property
    def compiled(self) -> Overlaps:
        """The prior as compiled code reads it."""
        return overlaps_of(self.body, self.sigma)


@lru_cache(maxsize=16)
def overlaps_of(body: Body, sigma: float) -> Overlaps:
    """Return the parts of a body for compiled code; sigma: overlap with energy 1/2, m."""
    first, second = _pairs(body)
    skeleton = body.skeleton
    return Overlaps(
        _axes_of(body),
        first.astype(np.int64),
        second.astype(np.int64),
        skeleton.dof_is_rotation,
        skeleton.moves,
        float(sigma),
    )


@lru_cache(maxsize=16)
def _axes_of(body: Body) -> _Axes:
    parts = body.flesh.parts
    radii = np.array([p.radii for p in parts]).reshape(-1, 3)
    mean = radii[:, :2].mean(1)
    halves = np.maximum(radii[:, 2] - mean, 0.0)
    return _Axes(
        np.array([p.segment for p in parts], dtype=np.int64),
        np.array([p.centre for p in parts]).reshape(-1, 3),
        halves,
        np.column_stack([radii[:, :2], mean]),
        halves + radii[:, :2].max(1, initial=0.0),
    )


@lru_cache(maxsize=16)
def _pairs(body: Body) -> tuple[Index, Index]:
    """Return pairs of parts that are not neighbours in the skeleton and do not touch at rest."""
    parts = body.flesh.parts
    parents = body.skeleton.parents
    fleshy = {p.segment for p in parts}

    def fleshy_parent(s: int) -> int:
        """The nearest ancestor segment that carries flesh."""
        step = parents[s]
        while step >= 0 and step not in fleshy:
            step = parents[step]
        return step

    pairs = []
    for i in range(len(parts)):
        for j in range(i + 1, len(parts)):
            a, b = parts[i].segment, parts[j].segment
            if a != b and fleshy_parent(a) != b and fleshy_parent(b) != a:
                pairs.append((i, j))
    first, second = np.ascontiguousarray(np.array(pairs, dtype=np.intp).reshape(-1, 2).T)
    rest = body.prior_mean.copy()
    rest[~body.skeleton.dof_is_rotation] = 0.0
    (columns,), (origins,) = forward(body.skeleton, rest[None]).by_pose()
    depths = np.empty(len(first))
    overlap_depths(_axes_of(body), first, second, columns, origins, depths)
    return first[depths < TOLERANCE], second[depths < TOLERANCE]
