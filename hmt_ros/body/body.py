"""The body: its skeleton, its flesh, and the prior of its poses.

A symmetry maps a pose to another pose with nearly the same image:

    p(dt) = (1 - exp(-2 q dt)) / 2        q: rate of the symmetry, 1/s                          (1)

p is the probability that a track has switched to the mapped pose after dt seconds, in a two-state
chain with rate q. The model file has the table of rates; `MAPS` lists the maps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body import kinematics
from hmt_ros.body.flesh import Flesh, Superquadric
from hmt_ros.body.skeleton import Skeleton, sided_pairs
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import product
from hmt_ros.inference.logistic import probability_of

# Columns of the growth, which is the difference of a part of the flesh from the model file: log
# factors on the x and y radii, additional extent beyond the start and the end of its segment, m,
# and shift along the y axis, m.
GROWTH_COLUMNS = ('width', 'depth', 'start', 'end', 'shift')
# Angles of the root in bodies that `levelled` supports.
ROOT_ANGLES = ('root_z', 'root_y', 'root_x')
# Minimum half height of a part, m.
MIN_HEIGHT = 5e-3


@dataclass(frozen=True)
class PartShape:
    """Shape of a part of the flesh as a function of the lengths of the body.

    Attributes:
        segment: index of the segment that carries the part.
        length: index of the length that the part spans; None for a part of fixed proportions.
        centre: centre of the part in its segment's frame, m; if the part spans a length, the shift
            of the centre from the middle of that length.
        radii: semi-axes (x, y) if the part spans a length, else (x, y, z), m.
        exponents, taper, bend: shape parameters, as in `Superquadric`.
        extend: distances by which the part exceeds the start and the end of the length, m.
        rings: number of rings at which the contour of the part is sampled.
        size: index of the length with which the part scales in all directions; None: the whole
            body.
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
    size: int | None = None

    def part(self, lengths: Array, scale: float, growth: Array) -> Superquadric:
        """Return the part for given lengths and growth.

        Args:
            lengths: (L,) lengths of the body, m.
            scale: size of the part relative to the model file.
        """
        width, depth, more_start, more_end, shift = (float(x) for x in growth)
        start, end = scale * self.extend[0] + more_start, scale * self.extend[1] + more_end
        cx, cy, cz = (scale * x for x in self.centre)
        rx, ry = (scale * x * float(elementary.exp(g)) for x, g in zip(self.radii, (width, depth)))
        if self.length is None:
            rz = scale * self.radii[2] + 0.5 * (more_start + more_end)
            cz += 0.5 * (more_start - more_end)
        else:
            span = float(lengths[self.length])
            rz = 0.5 * (span + start + end)
            cz -= 0.5 * (span + end - start)
        rz = max(rz, MIN_HEIGHT)
        return Superquadric(
            self.segment, (cx, cy + shift, cz), (rx, ry, rz), self.exponents, self.taper, self.bend
        )


@dataclass(frozen=True, eq=False)
class Body:
    """Model of a person: the meaning of a pose vector, and the shape of the flesh.

    Poses have shape (N, d): root translation in the camera optical frame (m), root rotation, joint
    angles (rad). Use `load_body` to make a body.

    Attributes:
        skeleton: segments, degrees of freedom, joints and lengths.
        shapes: parts of the flesh; empty for a bare skeleton.
        prior_mean, prior_sigma: (d,) Gaussian prior of each degree of freedom; a sigma of inf
            means no prior.
        rates: (d,) variance that a random walk of each degree of freedom gains per second, m^2 or
            rad^2.
        length_covariance: (L, L) covariance of the lengths over people, or of the estimate for this
            person, m^2.
        stature_lengths, stature_extra: the stature is the sum of these lengths plus the extra, m,
            which scales with the lengths.
        default_lengths: (L,) lengths of the model file, m.
        symmetries: the symmetry for each map in `MAPS`.
        joint_errors: (J,) standard deviation of the constant error of each joint's coordinates
            relative to the pelvis, m, because people's joints differ from the model's.
        growth: (B, 5) difference of each part from the model file; see `GROWTH_COLUMNS`.
        level: (3, 3) rotation from the reference axes of the root's angles to the axes of the
            camera; see `levelled`.
    """

    skeleton: Skeleton
    shapes: tuple[PartShape, ...]
    prior_mean: Array
    prior_sigma: Array
    rates: Array
    length_covariance: Array
    stature_lengths: tuple[str, ...]
    stature_extra: float
    default_lengths: Array
    symmetries: Mapping[str, Symmetry]
    joint_errors: Array
    growth: Array = field(default_factory=lambda: np.zeros((0, len(GROWTH_COLUMNS))))
    level: Array = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        wanted = (len(self.shapes), len(GROWTH_COLUMNS))
        growth = np.array(self.growth, dtype=np.float64) if len(self.growth) else np.zeros(wanted)
        if growth.shape != wanted or not np.isfinite(growth).all():
            raise ValueError(
                f'{self.name}: growth must be {wanted} finite numbers, saw {growth.shape}'
            )
        growth.setflags(write=False)
        object.__setattr__(self, 'growth', growth)
        if self.rates.shape != (self.dimension,) or not (self.rates > 0).all():
            raise ValueError(
                f'{self.name}: rates must be {self.dimension} positive numbers, saw {self.rates}'
            )
        count, covariance = len(self.skeleton.lengths), self.length_covariance
        if covariance.shape != (count, count) or not np.allclose(covariance, covariance.T):
            raise ValueError(
                f'{self.name}: length_covariance must be symmetric, {(count, count)}, saw '
                f'{covariance.shape}'
            )

        errors = self.joint_errors
        if errors.shape != (len(self.joint_names),) or not (errors >= 0).all():
            raise ValueError(
                f'{self.name}: joint_errors must be {len(self.joint_names)} numbers of at least 0, '
                f'saw {errors}'
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

    @cached_property
    def chain_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of names of left and right chains."""
        return sided_pairs(self.skeleton.chains)

    @property
    def trunk_joints(self) -> tuple[str, ...]:
        """Names of the joints that no chain moves."""
        return self.skeleton.trunk_joints

    @cached_property
    def trunk_pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of names of left and right trunk joints, which show where the person faces."""
        return sided_pairs(self.skeleton.trunk_joints)

    @property
    def segment_lengths(self) -> dict[str, float]:
        """Lengths by name, m."""
        return dict(zip(self.skeleton.length_names, map(float, self.skeleton.lengths), strict=True))

    @property
    def length_sigma(self) -> Array:
        """Standard deviations of the lengths (L,), m."""
        return np.sqrt(np.diagonal(self.length_covariance))

    @property
    def stature_rates(self) -> Array:
        """Derivatives (L,) of the stature with respect to the lengths."""
        names = self.skeleton.length_names
        rate = 1.0 + self.stature_extra / self._sum_of(self.default_lengths)
        return np.array([rate if name in self.stature_lengths else 0.0 for name in names])

    @cached_property
    def stature(self) -> float:
        """Height of the person standing upright, m."""
        return self._sum_of(self.skeleton.lengths) + self.stature_extra * self.scale

    @cached_property
    def scale(self) -> float:
        """Size of the body relative to its model file."""
        return self._sum_of(self.skeleton.lengths) / self._sum_of(self.default_lengths)

    def scale_of(self, shape: PartShape) -> float:
        """Size of one part relative to the model file, without its growth."""
        if shape.size is None:
            return self.scale
        return float(self.skeleton.lengths[shape.size] / self.default_lengths[shape.size])

    def scale_rates(self, shape: PartShape) -> dict[int, float]:
        """Derivatives of `scale_of` with respect to the lengths that it depends on, 1/m."""
        if shape.size is not None:
            return {shape.size: 1.0 / float(self.default_lengths[shape.size])}
        names, whole = self.skeleton.length_names, self._sum_of(self.default_lengths)
        return {names.index(name): 1.0 / whole for name in self.stature_lengths}

    @cached_property
    def flesh(self) -> Flesh:
        """The flesh with the current lengths and growth."""
        parts = tuple(
            shape.part(self.skeleton.lengths, self.scale_of(shape), growth)
            for shape, growth in zip(self.shapes, self.growth, strict=True)
        )
        return Flesh(parts, tuple(shape.rings for shape in self.shapes))

    def joint_positions(self, poses: ArrayLike) -> Array:
        """Joint positions (N, J, 3) of poses (N, d), camera frame, m."""
        return kinematics.joint_positions(self.skeleton, poses)

    def relative_joints(self, poses: ArrayLike) -> Array:
        """Joints (N, J, 3) of poses (N, d) relative to the first joint, m, to compare poses."""
        return kinematics.joint_positions(self.skeleton, poses, relative=True)

    def joint_jacobians(self, poses: ArrayLike) -> Array:
        """Derivatives (N, J, 3, d) of the joint positions with respect to the poses (N, d)."""
        frames = kinematics.forward(self.skeleton, poses)
        segments = self.skeleton.joint_segments
        points = frames.places(segments, self.skeleton.joint_offsets)
        return kinematics.point_jacobians(frames, segments, points)

    def with_segment_lengths(self, lengths: Mapping[str, float]) -> Body:
        """Return a copy of the body with new values (m) of some lengths.

        Raises:
            KeyError: the body has no length of this name.
            ValueError: a length is not finite.
        """
        return replace(self, skeleton=self.skeleton.with_lengths(lengths))

    def with_stature(self, stature: float) -> Body:
        """Return a copy of the body with all lengths and their spread scaled to a stature, m.

        Raises:
            ValueError: the stature is not a positive number.
        """
        if not (np.isfinite(stature) and stature > 0):
            raise ValueError(f'stature must be a positive number of metres, saw {stature}')
        factor = stature / self.stature
        skeleton = replace(self.skeleton, lengths=self.skeleton.lengths * factor)
        covariance = self.length_covariance * factor**2
        return replace(self, skeleton=skeleton, length_covariance=covariance)

    def with_growth(self, growth: ArrayLike) -> Body:
        """Return a copy of the body with a new growth (B, 5) of the parts; see `GROWTH_COLUMNS`.

        Raises:
            ValueError: the shape is wrong, or a number is not finite.
        """
        return replace(self, growth=np.asarray(growth, dtype=np.float64))

    def with_beliefs(
        self, *, prior_sigma: Array | None = None, joint_errors: Array | None = None
    ) -> Body:
        """Return a copy of the body with a new prior or new joint errors, and the same flesh."""
        result = replace(
            self,
            prior_sigma=self.prior_sigma if prior_sigma is None else prior_sigma,
            joint_errors=self.joint_errors if joint_errors is None else joint_errors,
        )
        result.__dict__['flesh'] = self.flesh
        return result

    def levelled(self, level: Array) -> Body:
        """Return a copy of the body with root angles measured in the axes of an upright camera.

        The root angles of an upright person are then far from singularities and limits, however the
        camera is oriented. Translations stay in the axes of the camera. A body that lacks
        `ROOT_ANGLES` is returned unchanged.

        Args:
            level: (3, 3) rotation from the axes of an upright camera to the camera's axes.
        """
        if np.array_equal(level, self.level) or not {*ROOT_ANGLES} <= {*self.dof_names}:
            return self
        mounts = self.skeleton.mounts.copy()
        mounts[0] = product(product(level, self.level.T), mounts[0])
        return replace(self, skeleton=replace(self.skeleton, mounts=mounts), level=level)

    def _sum_of(self, lengths: Array) -> float:
        names = self.skeleton.length_names
        return float(sum(lengths[names.index(x)] for x in self.stature_lengths)) or 1.0


# The maps, and the part of the pose class that each map changes.
MAPS: Mapping[str, str] = MappingProxyType(
    {
        'reversal': 'the way to face: the whole pose in a mirror across the line of sight',
        'trunk_flip': 'the lean: hips, trunk or shoulders turned towards or away',
        'exchange': 'which limb of a pair is which: each on the image of the other one',
        'limb_flip': 'the bend of a limb: a segment towards or away',
    }
)


@dataclass(frozen=True)
class Symmetry:
    """Two-state chain of a pose and its mapped pose, which has nearly the same image.

    Attributes:
        rate: Rate of switching to the mapped pose, 1/s.
    """

    rate: float

    def __post_init__(self) -> None:
        if not 0.0 < self.rate < math.inf:
            raise ValueError(f'the rate of a symmetry must be positive, saw {self.rate} 1/s')

    def probability(self, dt: float) -> float:
        """Probability p(dt) of the mapped pose after dt seconds, equation (1)."""
        return float(-0.5 * elementary.expm1(-2.0 * self.rate * dt))

    def price(self, dt: float) -> float:
        """-log p(dt), nats; infinite at dt = 0."""
        return -float(elementary.log(self.probability(dt))) if dt > 0.0 else math.inf

    def after(self, log_odds: float, dt: float) -> float:
        """Log odds of the mapped pose after dt seconds, given the present log odds."""
        p = float(probability_of(log_odds))
        p += self.probability(dt) * (1.0 - 2.0 * p)
        return float(elementary.log(p) - elementary.log1p(-p))


def symmetries_of(entries: Mapping[str, Any]) -> Mapping[str, Symmetry]:
    """Build the symmetries from the rates in a model file, one rate per map.

    Raises:
        ValueError: a map is unknown or missing, or a rate is not positive.
    """
    if set(entries) != set(MAPS):
        raise ValueError(f'symmetries: wanted rates of {list(MAPS)}, saw {list(entries)}')
    return MappingProxyType({name: Symmetry(float(entries[name])) for name in MAPS})
