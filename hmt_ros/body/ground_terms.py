"""Energy of poses against gravity and a floor: upright and above the floor.

    E(x) = w_u sum_s rho(lean_s) + w_f sum_p rho([-h_p]+ / sigma_f)
    rho(r) = (nu + k) / 2 log(1 + r^2 / nu),     k the dimension of r

`lean_s` is the direction of gravity in the frame of the pelvis or trunk, minus the same direction
for an upright person; h_p is the height of a point of the sole above the floor. The tails are heavy
because people bend and lie down. A floor that is only known from the track's own feet is not used,
because an overestimated height would also raise the feet in later images.

The soles are the contact points between the flesh of the feet and a floor. The points of a foot are
the lowest points of its flesh when the flat foot is pitched by `PITCH` up (heel) or down (toe).
They move with the flesh when the shape changes.

The mass fractions of the segments, and the distances of their centres of mass from the upper ends
as fractions of the segment lengths, are from [Winter, Biomechanics and Motor Control of Human
Movement, 4th ed. 2009, table 4.1, after Dempster]. Winter's 0.497 for the trunk is split into 0.142
for the pelvis and 0.355 for thorax and abdomen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.flesh import Flesh
from hmt_ros.body.kinematics import Frames, forward, point_jacobians, point_positions
from hmt_ros.body.skeleton import Skeleton, other_side
from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.linear_algebra import product, unit

# Mean forward lean of trunk and pelvis, and its standard deviations sideways and forwards, rad.
# People differ: their mean lean from hips to neck in the clips ranges from 9 degrees backwards to 9
# degrees forwards. The median of 16 people in motion capture is 2 degrees backwards for the trunk
# and 1 degree for the pelvis; on the clips, 8 degrees work better for the pelvis. The heavy tails
# allow bending.
TRUNK_LEAN, TRUNK_SIGMA = 0.0, (np.radians(5.0), np.radians(9.0))
PELVIS_LEAN, PELVIS_SIGMA = np.radians(-8.0), (np.radians(8.0), np.radians(14.0))
# Mean lean and standard deviations for the shanks of hidden legs, which are upright in standing and
# sitting people. The lean of visible shanks is measured in the image.
SHANK_LEAN, SHANK_SIGMA = np.radians(5.0), (np.radians(8.0), np.radians(20.0))
# Standard deviation of the depth below an exact floor plane, m.
FLOOR_SIGMA = 0.02
# Degrees of freedom nu of the heavy tails of the lean and of the floor.
LEAN_TAILS, FLOOR_TAILS = 2.0, 4.0


@dataclass(frozen=True)
class GroundSettings:
    """Weights of the known gravity and floor.

    Attributes:
        upright_weight: Factor on the prior of the lean of pelvis and trunk against the vertical; it
            replaces that of the root's angles, which are measured against the camera. 0 keeps them.
        floor_weight: Factor on the energy of feet below the floor; 0 switches it off.
    """

    upright_weight: float = 1.0
    floor_weight: float = 1.0

    def __post_init__(self) -> None:
        for name in ('upright_weight', 'floor_weight'):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f'ground.{name} must be a number of at least 0, saw {value}')

    @property
    def weights(self) -> Array:
        """Weights (2,) of the upright term and the floor term."""
        return np.array([self.upright_weight, self.floor_weight])

    @property
    def on(self) -> bool:
        """Whether any weight is positive."""
        return bool(self.weights.any())


@dataclass(frozen=True, eq=False)
class FloorPlane:
    """Gravity and floor, as inputs of the terms.

    Attributes:
        up: (3,) unit vector against gravity, camera frame.
        up_sigma: standard deviation of the angle of `up`, rad.
        height: height of the camera above the floor, m; None: unknown.
        height_sigma: standard deviation of the floor's height at the person, m.
        measured: whether the height is known independently of the person's own feet. If not, the
            height only describes earlier positions of the feet.
    """

    up: Array
    up_sigma: float
    height: float | None
    height_sigma: float
    measured: bool = True


class Constants(NamedTuple):
    """Inputs that do not depend on the pose, for the compiled code.

    Attributes:
        dof_is_rotation: (d,) whether each degree of freedom is a rotation.
        moves: (S, d) whether each degree of freedom moves each segment.
        weights: (2,) weights of the upright and the floor term; 0 switches a term off.
        up: (3,) unit vector against gravity.
        height: height of the camera above the floor, m.
        upright: (U,) segments with a prior of being upright.
        axes: (U, 3, 3) axes of these segments: to the side, ahead, up.
        lean: (U, 3) standard deviations of gravity along these axes, rad.
        soles: (P,) segments that carry the sole points.
        local: (P, 3) positions of the sole points in the segments' frames, m.
        per_floor: 1 / standard deviation of the height of the floor, 1/m.
        lean_tails, floor_tails: degrees of freedom of the robust costs.
    """

    dof_is_rotation: NDArray[np.bool_]
    moves: NDArray[np.bool_]
    weights: Array
    up: Array
    height: float
    upright: NDArray[np.int64]
    axes: Array
    lean: Array
    soles: NDArray[np.int64]
    local: Array
    per_floor: float
    lean_tails: float
    floor_tails: float


@dataclass(frozen=True, eq=False)
class GroundTerm:
    """Energy of poses: the sum of the upright term and the floor term.

    Attributes:
        body: body of the poses.
        settings: weights; a weight of 0 leaves a term out.
        plane: gravity and floor.
        hidden: segments that are hidden from the camera.
    """

    body: Body
    settings: GroundSettings
    plane: FloorPlane
    hidden: tuple[int, ...] = ()

    @cached_property
    def compiled(self) -> Constants:
        """The constants for the compiled code."""
        body, plane = self.body, self.plane
        skeleton, feet = body.skeleton, soles(body)
        upright = upright_segments(skeleton, self.hidden)
        weights = self.settings.weights
        weights[0] *= len(upright.segments) > 0
        weights[1] *= len(feet) > 0 and plane.height is not None and plane.measured
        lean = elementary.hypot(upright.sigma, plane.up_sigma)
        floor = float(elementary.hypot(FLOOR_SIGMA, plane.height_sigma))
        return Constants(
            skeleton.dof_is_rotation,
            skeleton.moves,
            weights,
            np.asarray(plane.up, dtype=np.float64).copy(),
            0.0 if plane.height is None else float(plane.height),
            upright.segments,
            upright.axes,
            lean,
            feet.segments,
            feet.local,
            0.0 if plane.height is None else 1.0 / floor,
            LEAN_TAILS,
            FLOOR_TAILS,
        )


class Upright(NamedTuple):
    """Segments that are upright in a standing person.

    Attributes:
        segments: (U,) indices of the segments.
        axes: (U, 3, 3) axes in the frame of each segment; the rows point to the side, ahead and up
            when the person stands normally.
        sigma: (U, 3) standard deviations of the vertical along these axes, rad.
    """

    segments: NDArray[np.intp]
    axes: Array
    sigma: Array


@lru_cache(maxsize=16)
def upright_segments(skeleton: Skeleton, hidden: tuple[int, ...] = ()) -> Upright:
    """Return pelvis and trunk if the root of the skeleton turns about z, y and x, otherwise none.

    Args:
        hidden: segments hidden from the camera. Hidden shanks are added to the result.
    """
    if not len(_root_turns(skeleton)) or 'neck' not in skeleton.joint_names:
        return Upright(np.zeros(0, dtype=np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    neck = skeleton.joint_index(('neck',))[0]
    trunk = skeleton.parents[skeleton.joint_segments[neck]]
    columns, origins, joints = _at_rest(skeleton)
    spine = joints[neck] - origins[max(trunk, 0)]
    known = [(trunk, spine, TRUNK_LEAN, TRUNK_SIGMA)]
    if skeleton.segment_dofs[trunk]:
        known.append((0, columns[0, 2], PELVIS_LEAN, PELVIS_SIGMA))
    for own in skeleton.chains.values():
        for shank, foot in pairwise(own[1:]):
            if shank in hidden:
                known.append((shank, origins[shank] - origins[foot], SHANK_LEAN, SHANK_SIGMA))
    return Upright(
        np.array([segment for segment, *_ in known], dtype=np.intp),
        np.array([_axes(columns, segment, up, lean) for segment, up, lean, _ in known]),
        np.array([[aside, ahead, ahead] for *_, (aside, ahead) in known]),
    )


@lru_cache(maxsize=16)
def _at_rest(skeleton: Skeleton) -> tuple[Array, Array, Array]:
    """Axes (S, 3, 3) and origins (S, 3) of the segments, and joints (J, 3), at zero angles."""
    frames = forward(skeleton, np.zeros((1, skeleton.dimension)))
    (columns,), (origins,) = frames.segments
    return columns, origins, frames.joints()[..., 0]


def _axes(columns: Array, segment: int, along: Array, lean: float) -> Array:
    """Return axes (3, 3) in the frame of a segment: to the side, ahead and up.

    Args:
        columns: (S, 3, 3) frames at rest.
        along: (3,) upward long axis of the segment, in the same frame as the columns.
        lean: usual forward lean of the long axis in a standing person, rad.
    """
    up = unit(along)
    ahead = _across(columns[0, 1], up)
    sine, cosine = elementary.sin(lean), elementary.cos(lean)
    up, ahead = cosine * up - sine * ahead, cosine * ahead + sine * up
    return np.asarray(product([np.cross(ahead, up), ahead, up], columns[segment].T))


def _across(vector: Array, axis: Array) -> Array:
    """Return the unit vector (3,) along the part of a vector that is perpendicular to an axis."""
    return unit(vector - axis * (axis * vector).sum())


def root_lean_dofs(body: Body) -> Index:
    """Return indices (L,) of the root rotations with a prior on the lean in the camera frame."""
    turns = _root_turns(body.skeleton)
    return np.asarray(turns[np.isfinite(body.prior_sigma[turns])], dtype=np.intp)


def _root_turns(skeleton: Skeleton) -> Index:
    """Return the root rotations (3,) if they are about z, y and x, otherwise an empty array."""
    root = np.array(skeleton.segment_dofs[0], dtype=np.intp)
    turns = root[skeleton.dof_is_rotation[root]]
    names = [skeleton.dof_names[i] for i in turns]
    return turns if names == ['root_z', 'root_y', 'root_x'] else turns[:0]


def without_root_lean(body: Body) -> Body:
    """Return the body without its prior on root angles relative to the camera."""
    lean = root_lean_dofs(body)
    if not len(lean):
        return body
    sigma = body.prior_sigma.copy()
    sigma[lean] = np.inf
    return body.with_beliefs(prior_sigma=sigma)


FEET = ('left', 'right')
# Pitch of the foot that defines the lowest points of heel and toe, rad.
PITCH = np.radians(15.0)
# Height of the ankle above the floor relative to the stature, for a foot without flesh [Winter,
# Biomechanics and Motor Control of Human Movement, 4th ed. 2009, figure 4.1].
ANKLE_HEIGHT = 0.039


@dataclass(frozen=True, eq=False)
class Soles:
    """Points of the soles: heel and toe of the left foot, then of the right foot.

    Attributes:
        segments: (P,) segments that carry the points; empty for a body without feet.
        local: (P, 3) positions of the points in the frames of the segments, m.
    """

    segments: Index
    local: Array

    def __len__(self) -> int:
        return len(self.segments)


def soles(body: Body) -> Soles:
    """Return the soles of a body; empty if it lacks an ankle or a toe on either side."""
    return _soles(body.skeleton, body.flesh, body.stature)


@lru_cache(maxsize=16)
def _soles(skeleton: Skeleton, flesh: Flesh, stature: float) -> Soles:
    wanted = [f'{side}_{joint}' for side in FEET for joint in ('ankle', 'toe')]
    if not set(wanted) <= set(skeleton.joint_names):
        return Soles(np.zeros(0, dtype=np.intp), np.zeros((0, 3)))
    joints = skeleton.joint_index(tuple(wanted)).reshape(2, 2)
    segments, local = [], []
    sine, cosine = elementary.sin(PITCH), elementary.cos(PITCH)
    for ankle, toe in joints:
        carrier = int(skeleton.joint_segments[toe])
        down, ahead = _down_and_ahead(skeleton, ankle, toe, carrier)
        points = flesh.points_on(carrier)
        if not len(points):
            own = skeleton.joint_offsets[toe]
            heel = own - ahead * (ahead * own).sum()
            points = np.array([heel, own]) + ANKLE_HEIGHT * stature * down
        for sign in (-1.0, 1.0):
            lowest = product(points, cosine * down + sign * sine * ahead)
            # Mean of the equally low points left and right of the middle line.
            local.append(points[lowest > lowest.max() - 1e-6].mean(0))
            segments.append(carrier)
    return Soles(np.array(segments, dtype=np.intp), np.array(local))


def sole_points(body: Body, poses: Array) -> Array:
    """Points (N, P, 3) of the soles of poses (N, d), camera frame, m."""
    feet = soles(body)
    return point_positions(body.skeleton, poses, feet.segments, feet.local)


def sole_jacobians(body: Body, poses: Array) -> Array:
    """Derivatives (N, P, 3, d) of the points of the soles with respect to the poses (N, d)."""
    feet, frames = soles(body), forward(body.skeleton, poses)
    return point_jacobians(frames, feet.segments, frames.places(feet.segments, feet.local))


def _down_and_ahead(skeleton: Skeleton, ankle: int, toe: int, carrier: int) -> tuple[Array, Array]:
    """Unit vectors towards the sole and the toe, in the frame of the foot.

    The first is the direction of the shin at zero angles, made perpendicular to the foot.
    """
    columns, origins, joints = _at_rest(skeleton)
    shin = joints[ankle] - origins[skeleton.parents[carrier]]
    ahead = unit(product(columns[carrier], joints[toe] - joints[ankle]))
    return _across(product(columns[carrier], shin), ahead), ahead


# Mass fraction of each segment, and its centre as a fraction of the way from start to end.
MASS_FRACTIONS = {
    'pelvis': (0.142, 0.0),
    'trunk': (0.355, 0.37),
    'head': (0.081, 1.0),
    'upper_arm': (0.028, 0.436),
    'forearm': (0.016, 0.430),
    'hand': (0.006, 0.506),
    'thigh': (0.100, 0.433),
    'shin': (0.0465, 0.433),
    'foot': (0.0145, 0.5),
}
# Minimum total mass fraction of the known segments of a body.
MIN_MASS_FRACTION = 0.8


@dataclass(frozen=True, eq=False)
class Masses:
    """Point masses of the segments.

    Attributes:
        shares: (S,) mass fractions with sum 1; all 0 if unknown.
        centres: (S, 3) centres of mass in the frames of the segments, m.
    """

    shares: Array
    centres: Array

    @property
    def known(self) -> bool:
        """Whether the masses are known."""
        return bool(self.shares.any())

    def centre_of_mass(self, frames: Frames) -> Array:
        """Centres of mass (N, 3) of poses, camera frame, m."""
        places = frames.places(np.arange(len(self.shares)), self.centres)
        return np.asarray(product(self.shares, places))


@lru_cache(maxsize=16)
def masses(skeleton: Skeleton) -> Masses:
    """Return the masses of a skeleton; unknown masses if `MASS_FRACTIONS` lacks its segments."""
    count = len(skeleton.parents)
    shares, centres = np.zeros(count), np.zeros((count, 3))
    for s, name in enumerate(skeleton.segment_names):
        bare = name.split('_', 1)[1] if other_side(name) != name else name
        if bare not in MASS_FRACTIONS:
            continue
        shares[s], way = MASS_FRACTIONS[bare]
        centres[s] = way * _end(skeleton, s)
    if shares.sum() < MIN_MASS_FRACTION:
        return Masses(np.zeros(count), centres)
    return Masses(shares / shares.sum(), centres)


def _end(skeleton: Skeleton, segment: int) -> Array:
    """Return the end (3,) of a segment, m: its farthest joint or the next segment's start."""
    ends = [np.zeros(3), *skeleton.joint_offsets[skeleton.joint_segments == segment]]
    children = [s for s, parent in enumerate(skeleton.parents) if parent == segment]
    # There may be several child segments, such as both upper arms and the neck.
    if children:
        ends.append(np.mean([skeleton.offsets[s] for s in children], axis=0))
    return np.asarray(max(ends, key=lambda end: float((end * end).sum())), dtype=np.float64)
