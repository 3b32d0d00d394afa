"""The shape of a person as a vector: the lengths, and how the parts of the flesh differ.

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

import numpy as np
from numba import njit

from hmt_ros.body.body import GROWTH, Body
from hmt_ros.body.kinematics import Frames, origin_length_jacobians
from hmt_ros.inference.arrays import Array, Index


class ShapeSpace:
    """What can change in the shape of a body.

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
        self._part_of_segment = np.full(len(body.skeleton.parents), -1)
        for part, shape in enumerate(body.shapes):
            self._part_of_segment[shape.segment] = part

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

    def moved(self, change: Array) -> Body:
        """The body with a changed shape, (P,): lengths in m, growth as in `GROWTH`."""
        names, own = self.body.skeleton.length_names, self.body.skeleton.lengths
        lengths = own + change[: self.lengths]
        grown = change[self.lengths :].reshape(len(self.groups), len(GROWTH))[self._group]
        body = self.body.with_segment_lengths(dict(zip(names, map(float, lengths), strict=True)))
        return body.with_growth(body.growth + grown)

    def point_derivatives(
        self, frames: Frames, segments: Index, points: Array, directions: Array
    ) -> Array:
        """How far points on the flesh move in given directions when the shape changes.

        Args:
            frames: of one pose of the body.
            segments: (M,) that carry the points.
            points: (M, 3) on the flesh, camera frame, m.
            directions: (M, 3).

        Returns:
            (M, P) a . dp / dtheta.
        """
        columns, origins = (x[0] for x in frames.by_pose())
        result = np.zeros((len(points), self.size))
        _move_points(
            self._part_of_segment, *self._parts, self._origin_jacobians(frames), columns, origins,
            segments, points, directions, result,
        )  # fmt: skip
        return result

    def joint_derivatives(self, frames: Frames, joints: Index) -> Array:
        """Derivatives (n, 3, L) of joints with respect to the lengths, at one pose."""
        skeleton = self.body.skeleton
        segments = skeleton.joint_segments[joints]
        columns = frames.by_pose()[0][0]
        basis = np.einsum('jik,jil->jkl', columns[segments], skeleton.joint_basis[joints])
        return np.asarray(self._origin_jacobians(frames)[segments] + basis)

    def _origin_jacobians(self, frames: Frames) -> Array:
        result: Array = origin_length_jacobians(self.body.skeleton, frames)[..., 0]
        return result

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


@njit(cache=True, nogil=True)
def _move_points(  # type: ignore[no-untyped-def]
    part_of, centres, radii, by_centre, by_radius, lift, columns, origins, segments, points,
    directions, result,
):  # fmt: skip
    """Fills the result of `ShapeSpace.point_derivatives`."""
    size, lengths = result.shape[1], lift.shape[2]
    for m in range(len(points)):
        s = segments[m]
        b = part_of[s]
        for i in range(3):
            turned, local = 0.0, 0.0
            for k in range(3):
                turned += columns[s, i, k] * directions[m, k]
                local += columns[s, i, k] * (points[m, k] - origins[s, k])
            place = (local - centres[b, i]) / radii[b, i]
            for p in range(size):
                result[m, p] += turned * (by_centre[b, i, p] + place * by_radius[b, i, p])
        for k in range(3):
            for q in range(lengths):
                result[m, q] += directions[m, k] * lift[s, k, q]
