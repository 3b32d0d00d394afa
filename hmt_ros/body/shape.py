"""The shape of a person as a vector: the lengths, and the growth of the parts of the flesh.

    theta = (lengths - lengths of the body, growth of each group of parts)

Left and right parts grow equally, so a group is a part or a pair of parts. A point p on a part
moves with the shape. The segment of the part moves with the lengths of its ancestors. On the part,
the point has the constant relative position u = (p - c) / r, where the centre c and the radii r
depend on the shape:

    dp / dtheta = d origin / dtheta + R (dc / dtheta + u dr / dtheta)

This is also the derivative of the occluding contour perpendicular to itself, because points of the
surface only slide along the contour (envelope theorem).
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import GROWTH_COLUMNS, Body
from hmt_ros.body.kinematics import Frames, origin_length_jacobians, placing_of
from hmt_ros.core import sum_shape_residuals
from hmt_ros.inference.arrays import Array, Mask

# Standard deviations over people and clothes, by kind of growth; see `GROWTH_COLUMNS` for units.
GROWTH_SIGMAS = dict(zip(GROWTH_COLUMNS, (0.2, 0.2, 0.02, 0.02, 0.02), strict=True))
# Minimum standard deviation of a length, m.
MIN_LENGTH_SIGMA = 0.008


class ShapeSpace:
    """The variables of the shape of a body.

    Args:
        body: body at which derivatives are taken; the vector 0 leaves it unchanged.

    Attributes:
        body: body at which derivatives are taken.
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
        """Number of lengths, L, the first variables."""
        return len(self.body.skeleton.length_names)

    @property
    def size(self) -> int:
        """Number of variables, P."""
        return self.lengths + len(self.groups) * len(GROWTH_COLUMNS)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the variables, (P,)."""
        grown = (f'{group}_{kind}' for group in self.groups for kind in GROWTH_COLUMNS)
        return (*self.body.skeleton.length_names, *grown)

    @property
    def prior(self) -> tuple[Array, Array]:
        """Standard deviations (P,) over people, and covariance (P, P) for this person."""
        lengths = np.maximum(self.body.length_sigma, MIN_LENGTH_SIGMA)
        unknown = lengths**2 - np.diagonal(self.body.length_covariance)
        grown = np.tile(np.array(list(GROWTH_SIGMAS.values())), len(self.groups))
        sigmas = np.concatenate([lengths, grown])
        covariance = np.diag(sigmas**2)
        own = slice(0, self.lengths)
        covariance[own, own] = self.body.length_covariance + np.diag(unknown)
        return sigmas, covariance

    def moved(self, change: Array) -> Body:
        """Return the body after a change (P,) of shape: lengths in m, then `GROWTH_COLUMNS`."""
        names, own = self.body.skeleton.length_names, self.body.skeleton.lengths
        lengths = own + change[: self.lengths]
        grown = change[self.lengths :].reshape(len(self.groups), len(GROWTH_COLUMNS))[self._group]
        body = self.body.with_segment_lengths(dict(zip(names, map(float, lengths), strict=True)))
        return body.with_growth(body.growth + grown)

    def second_order(
        self, frames: Frames, of_flesh: Array, of_joints: Array
    ) -> tuple[Array, Array, Array]:
        """Sum products of the derivatives of residuals of N poses: r by shape, q by pose.

        Args:
            frames: frames of the poses.
            of_flesh: (N, 1 + M, 9) residuals of points on the flesh. Row 0 starts with the count m.
                Rows 1 to m contain the segment; the point and the derivative of the residual with
                respect to it, camera frame; and the first derivative g and second derivative c of
                the energy with respect to the residual.
            of_joints: the same for joints, with joints in place of segments.

        Returns:
            sum g r (N, P), sum c r r' (N, P, P) and sum c r q' (N, P, d).
        """
        n, size, skeleton = frames.count, self.size, self.body.skeleton
        d = skeleton.dimension
        result = np.zeros((n, size)), np.zeros((n, size, size)), np.zeros((n, size, d))
        sum_shape_residuals(
            self._table,
            origin_length_jacobians(skeleton, frames),
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
                len(GROWTH_COLUMNS) * self._group[b], len(GROWTH_COLUMNS) * (self._group[b] + 1)
            )
            by_radius[b, 0, width], by_radius[b, 1, depth] = radii[b, :2]
            by_radius[b, 2, [more_start, more_end]] = 0.5
            by_centre[b, 2, more_start], by_centre[b, 2, more_end] = 0.5, -0.5
            by_centre[b, 1, shift] = 1.0
        return centres, radii, by_centre, by_radius


class _ShapeTable(NamedTuple):
    """The shape as compiled code reads it.

    Attributes:
        part_of: (S,) part on each segment; -1 if missing.
        centres, radii: (B, 3) centres and radii of the parts.
        by_centre, by_radius: (B, 3, P) derivatives of centres and radii with respect to the
            variables.
        joint_basis: (J, 3, L) of the skeleton.
        variables, counts: (S, V), (S,) variables that move the flesh of each segment; their number.
    """

    part_of: NDArray[np.int64]
    centres: Array
    radii: Array
    by_centre: Array
    by_radius: Array
    joint_basis: Array
    variables: NDArray[np.int64]
    counts: NDArray[np.int64]
