"""The shape of a person as a vector: the lengths, and the growth of the parts of the flesh.

    theta = (lengths - lengths of the body, growth of each group of parts)

Left and right parts grow alike, so a group is a part or a pair of parts. A point p on a part moves
with the shape: its segment moves with the lengths above it, and on the part it keeps its place
u = (p - c) / r, in units of the radii r around the centre c, both of which the shape changes:

    dp / dtheta = d origin / dtheta + R (dc / dtheta + u dr / dtheta)

At the occluding contour this is also the derivative of the contour across itself, because the
surface only slides along it (envelope theorem).
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.body.body import GROWTH, Body
from hmt_ros.body.kinematics import Frames, origin_length_jacobians, placing_of
from hmt_ros.inference.arrays import Array, Mask

# Standard deviations over people and clothes, by kind of growth: logarithms, m.
GROWTH_SIGMAS = dict(zip(GROWTH, (0.2, 0.2, 0.02, 0.02, 0.02), strict=True))
# Smallest standard deviation of a length, m: none is known better.
MIN_LENGTH_SIGMA = 0.008


class ShapeSpace:
    """The variables of the shape of a body.

    Args:
        body: at which derivatives are taken; the vector 0 leaves it as it is.

    Attributes:
        body: the same.
        groups: names of the groups of parts, without sides.
    """

    def __init__(self, body: Body) -> None:
        self.body = body
        names = [body.skeleton.segment_names[shape.segment] for shape in body.shapes]
        plain = [name.removeprefix('left_').removeprefix('right_') for name in names]
        self.groups = tuple(dict.fromkeys(plain))
        self._group = np.array([self.groups.index(name) for name in plain], dtype=np.intp)

    @property
    def lengths(self) -> int:
        """Number of lengths, L; they come first."""
        return len(self.body.skeleton.length_names)

    @property
    def size(self) -> int:
        """Number of variables, P."""
        return self.lengths + len(self.groups) * len(GROWTH)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables, (P,)."""
        grown = (f'{group}_{kind}' for group in self.groups for kind in GROWTH)
        return (*self.body.skeleton.length_names, *grown)

    @property
    def prior(self) -> tuple[Array, Array]:
        """Standard deviations over people (P,) and covariance of this person (P, P)."""
        lengths = np.maximum(self.body.length_sigma, MIN_LENGTH_SIGMA)
        unknown = lengths**2 - np.diagonal(self.body.length_covariance)
        grown = np.tile(np.array(list(GROWTH_SIGMAS.values())), len(self.groups))
        sigmas = np.concatenate([lengths, grown])
        covariance = np.diag(sigmas**2)
        own = slice(0, self.lengths)
        covariance[own, own] = self.body.length_covariance + np.diag(unknown)
        return sigmas, covariance

    def moved(self, change: Array) -> Body:
        """The body with a changed shape, (P,): lengths in m, growth as in `GROWTH`."""
        names, own = self.body.skeleton.length_names, self.body.skeleton.lengths
        lengths = own + change[: self.lengths]
        grown = change[self.lengths :].reshape(len(self.groups), len(GROWTH))[self._group]
        body = self.body.with_segment_lengths(dict(zip(names, map(float, lengths), strict=True)))
        return body.with_growth(body.growth + grown)

    def second_order(
        self, frames: Frames, of_flesh: Array, of_joints: Array
    ) -> tuple[Array, Array, Array]:
        """Sums over residuals, whose derivatives by shape and pose are r and q, of N poses.

        Args:
            frames: of the poses.
            of_flesh: (N, 1 + M, 9) residuals of points on the flesh: rows 1 to m of a pose are
                segment, point and derivative a of the residual by it, camera frame, derivative g
                and curvature c of the energy by the residual; m is the first number of row 0.
            of_joints: the same of joints, which take the place of the segments.

        Returns:
            sum g r (N, P), sum c r r' (N, P, P) and sum c r q' (N, P, d).
        """
        n, size, skeleton = frames.count, self.size, self.body.skeleton
        d = skeleton.dimension
        result = np.zeros((n, size)), np.zeros((n, size, size)), np.zeros((n, size, d))
        lifts = origin_length_jacobians(skeleton, frames).transpose(3, 0, 1, 2)
        _sum_residuals(
            self._table,
            np.ascontiguousarray(lifts),
            placing_of(skeleton).parents,
            skeleton.dof_segments,
            skeleton.dof_is_rotation,
            skeleton.joint_segments,
            *frames.by_pose(),
            *frames.dofs_by_pose(),
            of_flesh,
            of_joints,
            *result,
        )
        return result

    @cached_property
    def _table(self) -> _ShapeTable:
        skeleton = self.body.skeleton
        part_of = np.full(len(skeleton.parents), -1)
        for part, shape in enumerate(self.body.shapes):
            part_of[shape.segment] = part
        centres, radii, by_centre, by_radius = self._parts
        moved = np.zeros((len(part_of), self.size), dtype=np.bool_)
        for s, parent in enumerate(skeleton.parents):
            moved[s, : self.lengths] = skeleton.offset_basis[s].any(0)
            if parent >= 0:
                moved[s, : self.lengths] |= moved[parent, : self.lengths]
        of_part: Mask = np.asarray(by_centre.any(1) | by_radius.any(1))
        moved |= of_part[part_of] & (part_of >= 0)[:, None]
        counts = moved.sum(1)
        variables = np.zeros((len(part_of), counts.max()), dtype=np.int64)
        for own, row in zip(variables, moved, strict=True):
            own[: row.sum()] = np.flatnonzero(row)
        return _ShapeTable(
            part_of.astype(np.int64),
            centres,
            radii,
            by_centre,
            by_radius,
            skeleton.joint_basis,
            variables,
            counts.astype(np.int64),
        )

    @cached_property
    def _parts(self) -> tuple[Array, Array, Array, Array]:
        """Centres, radii (B, 3) of the parts, and their derivatives (B, 3, P)."""
        body, parts = self.body, self.body.flesh.parts
        centres, radii = np.array([x.centre for x in parts]), np.array([x.radii for x in parts])
        by_centre, by_radius = np.zeros((2, len(parts), 3, self.size))
        for b, shape in enumerate(body.shapes):
            first, second, third = shape.centre
            start, end = shape.extend
            scale = body.scale_of(shape)
            by_scale = np.array([first, second, third]), np.append(radii[b, :2] / scale, 0.0)
            if shape.length is None:
                by_scale[1][2] = shape.radii[2]
            else:
                by_scale[0][2] -= 0.5 * (end - start)
                by_scale[1][2] = 0.5 * (start + end)
                by_centre[b, 2, shape.length], by_radius[b, 2, shape.length] = -0.5, 0.5
            for length, rate in body.scale_rates(shape).items():
                by_centre[b, :, length] += rate * by_scale[0]
                by_radius[b, :, length] += rate * by_scale[1]
            width, depth, more_start, more_end, shift = self.lengths + np.arange(
                len(GROWTH) * self._group[b], len(GROWTH) * (self._group[b] + 1)
            )
            by_radius[b, 0, width], by_radius[b, 1, depth] = radii[b, :2]
            by_radius[b, 2, [more_start, more_end]] = 0.5
            by_centre[b, 2, more_start], by_centre[b, 2, more_end] = 0.5, -0.5
            by_centre[b, 1, shift] = 1.0
        return centres, radii, by_centre, by_radius


class _ShapeTable(NamedTuple):
    """The shape as compiled code reads it.

    Attributes:
        part_of: (S,) part on each segment; -1: there is none.
        centres, radii: (B, 3) of the parts.
        by_centre, by_radius: (B, 3, P) their derivatives.
        joint_basis: (J, 3, L) of the skeleton.
        variables, counts: (S, V), (S,) the variables that move the flesh of each segment.
    """

    part_of: NDArray[np.int64]
    centres: Array
    radii: Array
    by_centre: Array
    by_radius: Array
    joint_basis: Array
    variables: NDArray[np.int64]
    counts: NDArray[np.int64]


@njit(cache=True, nogil=True)
def _sum_residuals(  # type: ignore[no-untyped-def]
    table,
    lifts,
    parents,
    dof_segments,
    is_rotation,
    joint_segments,
    columns,
    origins,
    axes,
    dof_origins,
    of_flesh,
    of_joints,
    gradient,
    curvature,
    mixed,
):
    """Adds up the sums of `ShapeSpace.second_order`.

    A residual on the flesh has r = B' f, with f = (R' a, u R' a, a) (9,) and B (9, P) the
    derivatives of centre, radii and origin, which are the same for all points of a segment; and
    q = T' b, with b = (a, p x a) and twists T (6, d). So sums of f f' and f b' over the residuals
    of a segment suffice.
    """
    segments, lengths = len(parents), lifts.shape[3]
    d, size = axes.shape[1], gradient.shape[1]
    pulls, squares, products = (
        np.empty((segments, 9)),
        np.empty((segments, 9, 9)),
        np.empty((segments, 9, 6)),
    )
    carried = np.empty((segments, size, 6))
    most = table.variables.shape[1]
    f, b, row = np.empty(9), np.empty(6), np.empty(lengths)
    rates, pushed, twist = np.empty((9, most)), np.empty((9, most)), np.empty(6)
    for n in range(len(columns)):
        lift = lifts[n]
        pulls[:], squares[:], products[:], carried[:] = 0.0, 0.0, 0.0, 0.0
        for m in range(1, 1 + int(of_flesh[n, 0, 0])):
            s = int(of_flesh[n, m, 0])
            point, a = of_flesh[n, m, 1:4], of_flesh[n, m, 4:7]
            pull, c = of_flesh[n, m, 7], of_flesh[n, m, 8]
            part = table.part_of[s]
            for i in range(3):
                turned, local = 0.0, 0.0
                for k in range(3):
                    turned += columns[n, s, i, k] * a[k]
                    local += columns[n, s, i, k] * (point[k] - origins[n, s, k])
                f[i] = turned
                f[3 + i] = turned * (local - table.centres[part, i]) / table.radii[part, i]
                f[6 + i] = a[i]
            _wrench(point, a, b)
            for i in range(9):
                pulls[s, i] += pull * f[i]
                for k in range(9):
                    squares[s, i, k] += c * f[i] * f[k]
                for k in range(6):
                    products[s, i, k] += c * f[i] * b[k]
        for s in range(segments):
            part, count = table.part_of[s], table.counts[s]
            if part < 0:
                continue
            for v in range(count):
                p = table.variables[s, v]
                for i in range(3):
                    rates[i, v] = table.by_centre[part, i, p]
                    rates[3 + i, v] = table.by_radius[part, i, p]
                    rates[6 + i, v] = lift[s, i, p] if p < lengths else 0.0
                for i in range(9):
                    total = 0.0
                    for k in range(9):
                        total += squares[s, i, k] * rates[k, v]
                    pushed[i, v] = total
                    gradient[n, p] += pulls[s, i] * rates[i, v]
                    for k in range(6):
                        carried[s, p, k] += rates[i, v] * products[s, i, k]
                for u in range(v + 1):
                    q, total = table.variables[s, u], 0.0
                    for i in range(9):
                        total += rates[i, u] * pushed[i, v]
                    curvature[n, q, p] += total
                    if u != v:
                        curvature[n, p, q] += total
        for m in range(1, 1 + int(of_joints[n, 0, 0])):
            joint = int(of_joints[n, m, 0])
            point, a = of_joints[n, m, 1:4], of_joints[n, m, 4:7]
            pull, c = of_joints[n, m, 7], of_joints[n, m, 8]
            s = joint_segments[joint]
            for p in range(lengths):
                row[p] = 0.0
                for k in range(3):
                    rate = lift[s, k, p]
                    for i in range(3):
                        rate += columns[n, s, i, k] * table.joint_basis[joint, i, p]
                    row[p] += a[k] * rate
            _wrench(point, a, b)
            for p in range(lengths):
                gradient[n, p] += pull * row[p]
                for q in range(lengths):
                    curvature[n, p, q] += c * row[p] * row[q]
                for k in range(6):
                    carried[s, p, k] += c * row[p] * b[k]
        for s in range(segments - 1, 0, -1):
            if parents[s] >= 0:
                carried[parents[s]] += carried[s]
        for j in range(d):
            twist[:3], twist[3:] = axes[n, j], 0.0
            if is_rotation[j]:  # (o x w, w)
                _wrench(dof_origins[n, j], axes[n, j], twist)
                for k in range(3):
                    twist[k], twist[3 + k] = twist[3 + k], twist[k]
            for p in range(size):
                total = 0.0
                for k in range(6):
                    total += carried[dof_segments[j], p, k] * twist[k]
                mixed[n, p, j] = total


@njit(cache=True, nogil=True, inline='always')
def _wrench(point, a, result):  # type: ignore[no-untyped-def]
    """Fills (6,) with (a, point x a)."""
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        result[k], result[3 + k] = a[k], point[i] * a[j] - point[j] * a[i]
