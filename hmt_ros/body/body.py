"""The body: skeleton, flesh and what is believed of a pose before an image is seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body import kinematics
from hmt_ros.body.flesh import Flesh, Superquadric
from hmt_ros.body.skeleton import Skeleton, sided_pairs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PartShape:
    """How a part of the flesh follows from the lengths of the body.

    Attributes:
        segment: index of the segment that carries the part.
        length: index of the length that the part spans, or None where `centre` and three radii say
            all.
        centre: of the part in its segment's frame, m; with a length, its shift from the middle.
        radii: (x, y) with a length, else (x, y, z), m.
        extend: how far the part reaches beyond the start and the end of the length, m.
    """

    segment: int
    length: int | None
    centre: tuple[float, float, float]
    radii: tuple[float, ...]
    exponents: tuple[float, float] = (1.0, 1.0)
    taper: tuple[float, float] = (0.0, 0.0)
    bend: tuple[float, float] = (0.0, 0.0)
    extend: tuple[float, float] = (0.0, 0.0)
    rings: int = 5

    def part(self, lengths: Array, scale: float, width: float) -> Superquadric:
        """The part at given lengths (L,), overall scale and width factor."""
        start, end = (scale * x for x in self.extend)
        cx, cy, cz = (scale * x for x in self.centre)
        rx, ry = (scale * width * x for x in self.radii[:2])
        if self.length is None:
            rz = scale * self.radii[2]
        else:
            span = float(lengths[self.length])
            rz = max(0.5 * (span + start + end), 1e-3)
            cz -= 0.5 * (span + end - start)
        return Superquadric(
            self.segment, (cx, cy, cz), (rx, ry, rz), self.exponents, self.taper, self.bend
        )


@dataclass(frozen=True, eq=False)
class Body:
    """A person: what a pose vector means, and what it looks like.

    Poses have shape (N, d): root translation in the camera optical frame (m), root rotation, joint
    angles (rad). Made by `load_body`.

    Attributes:
        skeleton: segments, degrees of freedom, joints, lengths.
        shapes: one entry a part of the flesh; empty for a bare skeleton.
        widths: factors on the x and y radii of each part.
        prior_mean, prior_sigma: (d,) soft prior of each degree of freedom; sigma is inf where
            nothing is believed.
        rates: (d,) variances that the degrees of freedom gain per second while nothing is seen, m^2
            or rad^2.
        length_sigma: (L,) standard deviation of the lengths over people, m.
        stature_lengths, stature_extra: the stature is the sum of these lengths plus the extra (m,
            at the default lengths; it scales with them).
        default_lengths: (L,) of the model file, m.
        keypoint_aliases: other names of joints, as keypoint detectors use them.
    """

    skeleton: Skeleton
    shapes: tuple[PartShape, ...]
    prior_mean: Array
    prior_sigma: Array
    rates: Array
    length_sigma: Array
    stature_lengths: tuple[str, ...]
    stature_extra: float
    default_lengths: Array
    widths: tuple[float, ...] = field(default=())
    keypoint_aliases: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.widths and self.shapes:
            object.__setattr__(self, 'widths', (1.0,) * len(self.shapes))
        if len(self.widths) != len(self.shapes):
            raise ValueError(f'{len(self.widths)} widths for {len(self.shapes)} parts')
        if self.rates.shape != (self.dimension,) or not (self.rates > 0).all():
            raise ValueError(
                f'{self.name}: rates must be {self.dimension} positive numbers, saw {self.rates}'
            )

    @property
    def name(self) -> str:
        """Name of the body model."""
        return self.skeleton.name

    @property
    def dimension(self) -> int:
        """Number of degrees of freedom, d."""
        return self.skeleton.dimension

    @property
    def dof_names(self) -> tuple[str, ...]:
        """Names of the degrees of freedom, (d,)."""
        return self.skeleton.dof_names

    @property
    def lower(self) -> Array:
        """Hard lower limits (d,), m and rad."""
        return self.skeleton.lower

    @property
    def upper(self) -> Array:
        """Hard upper limits (d,), m and rad."""
        return self.skeleton.upper

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, (J,)."""
        return self.skeleton.joint_names

    @property
    def chains(self) -> Mapping[str, tuple[int, ...]]:
        """Limbs: name -> segments from the root outwards."""
        return self.skeleton.chains

    @property
    def chain_pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the chains that are the left and the right one of a pair."""
        return sided_pairs(self.skeleton.chains)

    @property
    def trunk_joints(self) -> tuple[str, ...]:
        """Names of the joints that no chain moves."""
        return self.skeleton.trunk_joints

    @property
    def trunk_pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of the left and right joints of the trunk, which tell where the person faces."""
        return sided_pairs(self.skeleton.trunk_joints)

    @property
    def segment_lengths(self) -> dict[str, float]:
        """Lengths by name, m."""
        return dict(zip(self.skeleton.length_names, map(float, self.skeleton.lengths), strict=True))

    @property
    def stature(self) -> float:
        """Height of the person standing upright, m."""
        return self._sum_of(self.skeleton.lengths) + self.stature_extra * self.scale

    @property
    def scale(self) -> float:
        """Size of the body against that of its model file."""
        return self._sum_of(self.skeleton.lengths) / self._sum_of(self.default_lengths)

    @cached_property
    def flesh(self) -> Flesh:
        """The flesh at the present lengths and widths."""
        parts = tuple(
            shape.part(self.skeleton.lengths, self.scale, width)
            for shape, width in zip(self.shapes, self.widths, strict=True)
        )
        return Flesh(parts, tuple(shape.rings for shape in self.shapes))

    def joint_positions(self, poses: ArrayLike) -> Array:
        """Joint positions (N, J, 3) of poses (N, d), camera frame, m."""
        return kinematics.joint_positions(self.skeleton, poses)

    def joint_jacobians(self, poses: ArrayLike) -> Array:
        """Derivatives (N, J, 3, d) of the joint positions with respect to the poses (N, d)."""
        return kinematics.joint_jacobians(self.skeleton, poses)

    def with_segment_lengths(self, lengths: Mapping[str, float]) -> Body:
        """The same body with some lengths replaced, m.

        Raises:
            KeyError: a name that the body does not have.
            ValueError: a length that is not finite.
        """
        return replace(self, skeleton=self.skeleton.with_lengths(lengths))

    def with_stature(self, stature: float) -> Body:
        """The same body, all lengths scaled so that the person is this tall, m.

        Raises:
            ValueError: a stature that is not a positive number.
        """
        if not (np.isfinite(stature) and stature > 0):
            raise ValueError(f'stature must be a positive number of metres, saw {stature}')
        factor = stature / self.stature
        skeleton = replace(self.skeleton, lengths=self.skeleton.lengths * factor)
        return replace(self, skeleton=skeleton)

    def with_widths(self, widths: Sequence[float]) -> Body:
        """The same body with other factors on the x and y radii of its parts."""
        return replace(self, widths=tuple(float(x) for x in widths))

    def _sum_of(self, lengths: Array) -> float:
        names = self.skeleton.length_names
        return float(sum(lengths[names.index(x)] for x in self.stature_lengths)) or 1.0
