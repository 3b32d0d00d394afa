"""Energy of poses against gravity and a floor: upright, above the floor, balanced.

    E(x) = w_u sum_s rho(lean_s) + w_f sum_p rho([-h_p]+ / sigma_f)
         + w_b g rho([|c - q| - m]+ / sigma_b)
    rho(r) = (nu + k) / 2 log(1 + r^2 / nu),     k the dimension of r

`lean_s` is the direction of gravity in the frame of pelvis or trunk, less that of somebody
upright; h_p the height of a point of the sole over the floor; c the centre of mass and q the
nearest point of its support, both seen from above. All tails are heavy: people bend, jump and lean
on things. A floor that is only known from the feet of the track costs nothing: feet that were taken
for too high would hold the next ones up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.ground_kernel import Constants, add_ground_energies
from hmt_ros.body.kinematics import Frames, forward
from hmt_ros.body.mass import masses
from hmt_ros.body.soles import soles
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.energy import Derivatives, Energy

# Mean lean forwards of trunk and pelvis, and the deviations sideways and forwards or back, rad: the
# trunk is nearly vertical, the hips lie before the joint of pelvis and spine. Means follow medians
# of the truth of 13 rendered clips, deviations are chosen for people who stand or walk; tails are
# for those who bend.
TRUNK_LEAN, TRUNK_SIGMA = np.radians(3.0), (np.radians(5.0), np.radians(7.0))
PELVIS_LEAN, PELVIS_SIGMA = np.radians(-20.0), (np.radians(8.0), np.radians(12.0))
# Depth below the floor that costs 1/2, with an exact plane, m.
FLOOR_SIGMA = 0.02
# Distance from the support that costs nothing, and the deviation beyond it of somebody at rest, m.
SUPPORT_MARGIN, BALANCE_SIGMA = 0.05, 0.06
# Height of the centre of mass over the floor, of a person of 1.75 m, m: it turns an error of the
# vertical into one of the balance.
MASS_HEIGHT = 1.0
# Degrees of freedom nu of the heavy tails, of the lean and of the other terms.
LEAN_TAILS, TAILS = 2.0, 4.0


@dataclass(frozen=True)
class GroundSettings:
    """How far what is known of gravity and floor counts.

    Attributes:
        upright_weight: Factor on the prior of the lean of pelvis and trunk against the vertical; it
            replaces that of the root's angles, which are measured against the camera. 0 keeps them.
        floor_weight: Factor on the energy of feet below the floor; 0 switches it off.
        balance_weight: Factor on the energy of a centre of mass that is not over the feet; 0
            switches it off.
    """

    upright_weight: float = 1.0
    floor_weight: float = 1.0
    balance_weight: float = 1.0

    def __post_init__(self) -> None:
        for name in ('upright_weight', 'floor_weight', 'balance_weight'):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f'ground.{name} must be a number of at least 0, saw {value}')

    @property
    def weights(self) -> Array:
        """(3,) in the order of the attributes."""
        return np.array([self.upright_weight, self.floor_weight, self.balance_weight])

    @property
    def on(self) -> bool:
        """Whether any of the terms is on."""
        return bool(self.weights.any())


@dataclass(frozen=True, eq=False)
class FloorPlane:
    """Gravity and floor as the terms see them.

    Attributes:
        up: (3,) unit vector against gravity, camera frame.
        up_sigma: standard deviation of its angle, rad.
        height: of the camera over the floor, m; None: unknown.
        height_sigma: standard deviation of the floor's height where the person is, m.
        measured: whether the height is known apart from the person's own feet. If not, it says
            where they have stood, and nothing of where they are.
    """

    up: Array
    up_sigma: float
    height: float | None
    height_sigma: float
    measured: bool = True


@dataclass(frozen=True, eq=False)
class Stance:
    """How K poses stood in the image before: what the balance of their successors refers to.

    Attributes:
        balance_sigma: (K,) deviation of the centre of mass from the support, m, that motion allows.
        grounded: (K,) factor on the balance, from 0 in the air to 1 on the floor.
    """

    balance_sigma: Array
    grounded: Array

    def __getitem__(self, rows: Index | slice) -> Stance:
        return Stance(self.balance_sigma[rows], self.grounded[rows])


STANDING = Stance(np.array([BALANCE_SIGMA]), np.ones(1))


@dataclass(frozen=True, eq=False)
class GroundTerm:
    """The sum of the terms; a `FrameTerm`.

    Attributes:
        body: of the poses.
        settings: weights; a weight of 0 leaves a term out.
        plane: gravity and floor.
        stance: of each problem; None: all stand still.
    """

    body: Body
    settings: GroundSettings
    plane: FloorPlane
    stance: Stance | None = None

    def following(self, stance: Stance | None) -> GroundTerm:
        """The same with another stance."""
        result = replace(self, stance=stance)
        result.__dict__['_constants'] = self._constants
        return result

    def energy(
        self, frames: Frames, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """See `hmt_ros.body.pose_terms.FrameTerm`."""
        terms, gradient, hessian = self._evaluated(frames, rows, bool(derivatives))
        value = terms.sum(1)
        return Energy(value, gradient, hessian) if derivatives else Energy(value)

    def parts(self, frames: Frames, rows: Index) -> dict[str, Array]:
        """The terms one by one: name -> (N,)."""
        terms, _, _ = self._evaluated(frames, rows, False)
        return dict(zip(('upright', 'floor', 'balance'), terms.T, strict=True))

    def _evaluated(
        self, frames: Frames, rows: Index, derivatives: bool
    ) -> tuple[Array, Array, Array]:
        n, d = frames.count, self.body.dimension
        terms = np.zeros((n, 3))
        gradient = np.zeros((n if derivatives else 0, d))
        hessian = np.zeros((n if derivatives else 0, d, d))
        stance = self.stance or STANDING
        # One stance is that of all problems.
        stance = stance[rows if len(stance.grounded) > 1 else np.zeros(n, dtype=np.intp)]
        add_ground_energies(
            self._constants, stance.balance_sigma, stance.grounded,
            *frames.by_pose(), *frames.dofs_by_pose(), terms, gradient, hessian,
        )  # fmt: skip
        return terms, gradient, hessian

    @cached_property
    def _constants(self) -> Constants:
        body, plane = self.body, self.plane
        skeleton, feet, mass = body.skeleton, soles(body), masses(body)
        upright = upright_segments(body)
        weights = self.settings.weights
        weights[0] *= len(upright.segments) > 0
        weights[1:] *= len(feet) > 0
        weights[1] *= plane.height is not None and plane.measured
        weights[2] *= mass.known
        lean = np.hypot(upright.sigma, plane.up_sigma)
        floor = float(np.hypot(FLOOR_SIGMA, plane.height_sigma))
        return Constants(
            np.array(skeleton.parents, dtype=np.int64),
            np.array(skeleton.dof_segments, dtype=np.int64),
            np.array(skeleton.dof_is_rotation),
            skeleton.moves,
            weights,
            np.asarray(plane.up, dtype=np.float64).copy(),
            0.0 if plane.height is None else float(plane.height),
            upright.segments.astype(np.int64),
            upright.axes,
            lean,
            feet.segments.astype(np.int64),
            feet.local,
            0.0 if plane.height is None else 1.0 / floor,
            mass.shares,
            mass.centres,
            SUPPORT_MARGIN,
            plane.up_sigma * MASS_HEIGHT * body.scale,
            LEAN_TAILS,
            TAILS,
        )


class Upright(NamedTuple):
    """Segments that are upright in somebody who stands.

    Attributes:
        segments: (U,).
        axes: (U, 3, 3) in the frame of each; the rows point to the side, ahead and up when the
            person stands as usual.
        sigma: (U, 3) deviations of the vertical along these, rad.
    """

    segments: NDArray[np.intp]
    axes: Array
    sigma: Array


@lru_cache(maxsize=32)
def upright_segments(body: Body) -> Upright:
    """Pelvis and trunk of a body whose root turns about z, y and x; nothing of another."""
    if not len(_root_turns(body)) or 'neck' not in body.joint_names:
        return Upright(np.zeros(0, dtype=np.intp), np.zeros((0, 3, 3)), np.zeros((0, 3)))
    skeleton = body.skeleton
    neck = skeleton.joint_index(('neck',))[0]
    trunk = skeleton.parents[skeleton.joint_segments[neck]]
    frames = forward(skeleton, np.zeros((1, body.dimension)))
    columns = frames.columns[..., 0]
    spine = frames.joints()[neck, :, 0] - frames.origins[max(trunk, 0), :, 0]
    known = [(trunk, spine, TRUNK_LEAN, TRUNK_SIGMA)]
    if skeleton.segment_dofs[trunk]:
        known.append((0, columns[0, 2], PELVIS_LEAN, PELVIS_SIGMA))
    return Upright(
        np.array([segment for segment, *_ in known], dtype=np.intp),
        np.array([_axes(columns, segment, up, lean) for segment, up, lean, _ in known]),
        np.array([[aside, ahead, ahead] for *_, (aside, ahead) in known]),
    )


def _axes(columns: Array, segment: int, along: Array, lean: float) -> Array:
    """Axes (3, 3) in the frame of a segment: to the side, ahead and up.

    Args:
        columns: (S, 3, 3) frames at rest.
        segment: whose axes.
        along: (3,) its long axis upwards, as the columns.
        lean: how far the long axis leans forwards where the person stands as usual, rad.
    """
    up = along / np.linalg.norm(along)
    ahead = columns[0, 1] - up * float(up @ columns[0, 1])
    ahead /= np.linalg.norm(ahead)
    up, ahead = np.cos(lean) * up - np.sin(lean) * ahead, np.cos(lean) * ahead + np.sin(lean) * up
    result: Array = np.array([np.cross(ahead, up), ahead, up]) @ columns[segment].T
    return result


def root_lean_dofs(body: Body) -> Index:
    """The rotations of the root with a prior (L,): how far it leans, against the camera."""
    turns = _root_turns(body)
    return np.asarray(turns[np.isfinite(body.prior_sigma[turns])], dtype=np.intp)


def _root_turns(body: Body) -> Index:
    """The rotations of the root if they are those about z, y and x (3,); else none."""
    skeleton = body.skeleton
    root = np.array(skeleton.segment_dofs[0], dtype=np.intp)
    turns = root[skeleton.dof_is_rotation[root]]
    names = [skeleton.dof_names[i] for i in turns]
    return turns if names == ['root_z', 'root_y', 'root_x'] else turns[:0]


def without_root_lean(body: Body) -> Body:
    """A body without the prior of the root's angles against the camera."""
    lean = root_lean_dofs(body)
    if not len(lean):
        return body
    sigma = body.prior_sigma.copy()
    sigma[lean] = np.inf
    return replace(body, prior_sigma=sigma)
