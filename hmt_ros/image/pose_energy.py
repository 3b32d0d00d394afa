"""Energies of poses and their minima; the core evaluates all terms of an image in one pass.

    E(x) = E_image(x) + E_keypoints(x) + E_prior(x) + E_intersection(x) + E_ground(x) + E_flow(x)
           + E_motion(x)

The frames of a pose are computed once and used by all terms in `core/terms`. The core minimises
with the algorithm of `inference.bounded_newton`, but problem by problem instead of all problems in
common steps. If a term is not in the core, its `energy` is added, and `bounded_newton` finds the
minima.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.ground_terms import Constants, FloorPlane, GroundSettings, GroundTerm
from hmt_ros.body.kinematics import Placing, forward, placing_of
from hmt_ros.body.pose_prior import AnglePrior, MixturePrior, PriorModel
from hmt_ros.body.pose_terms import FrameTerm
from hmt_ros.body.self_intersection import Overlaps, SelfIntersection
from hmt_ros.core import solve
from hmt_ros.image.likelihood import ImageLikelihood, ObservedImage, observed
from hmt_ros.image.observation import Observation
from hmt_ros.image.optical_flow import FlowTerm
from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface_points import SurfacePoints
from hmt_ros.image.terms.image_term import NO_MAP
from hmt_ros.image.terms.keypoints import KeypointInputs, Keypoints, KeypointTerm
from hmt_ros.image.terms.registry import Model
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum, minimise
from hmt_ros.inference.energy import Derivatives, Energy, Quadratic, Student, add_energies
from hmt_ros.inference.threads import in_threads

CompiledTerm = (
    ObservedImage
    | KeypointTerm
    | MixturePrior
    | AnglePrior
    | SelfIntersection
    | GroundTerm
    | FlowTerm
)

# Length of a moderate step of an angle, rad, and of a position, m.
ROTATION_STEP, PLACE_STEP = 0.4, 0.3
# Initial damping of a minimisation, and decrease in a step below which the minimisation ends, nats.
DAMPING, TOLERANCE = 1.0, 1e-3
# Default maximum number of steps of a minimisation.
MAX_ITERATIONS = 40


def scale_of(body: Body) -> Array:
    """Length (d,) of a moderate step of each variable, rad or m."""
    return np.where(body.skeleton.dof_is_rotation, ROTATION_STEP, PLACE_STEP)


class Compiled(NamedTuple):
    """The terms as inputs of the compiled core; an absent term contributes 0.

    Attributes:
        placing: constants of the skeleton.
        model, inputs: inputs of the image terms.
        image, contour: whether an image term is on, and whether such a term needs the contour.
        keypoints, prior, overlaps, ground, flow: inputs of the other terms.
        centres, precisions: (R, f), (R, f, f) centres and precisions of the motion prior, one row
            per problem or a single row; (0, f), (0, f, f) without a motion prior.
        tails: degrees of freedom of the motion prior; 0 if it is Gaussian.
    """

    placing: Placing
    model: Model
    inputs: Any
    image: bool
    contour: bool
    keypoints: KeypointInputs
    prior: PriorModel
    overlaps: Overlaps
    ground: Constants
    flow: tuple[SurfacePoints, ImageMap, float]
    centres: Array
    precisions: Array
    tails: float


class Descent(NamedTuple):
    """Settings of the minimiser; see `bounded_newton.minimise`.

    Attributes:
        most: maximum number of evaluations per problem in addition to the first.
        damping, tolerance: initial damping lambda, and decrease in a step below which the descent
            ends.
        scale: (d,) length of a moderate step of each variable.
    """

    most: int
    damping: float
    tolerance: float
    scale: Array


NO_DESCENT = Descent(0, 1.0, 0.0, np.zeros(0))
NO_ROWS = np.zeros(0, dtype=np.intp)


@dataclass(frozen=True, eq=False)
class ByCue:
    """Energies of n poses by source: image, keypoints, and all other terms.

    Attributes:
        energy: sum over the sources.
        values: (n, 3) energy of each source.
        hessians: (n, 3, d, d) Hessian of each source; (0, 3, d, d) if not requested.
        outline_costs: (n, M) energy of each sample of the silhouette's outline.
    """

    energy: Energy
    values: Array
    hessians: Array
    outline_costs: Array


@dataclass(frozen=True, eq=False)
class PoseEnergy:
    """Sum of the terms of a body's pose; an `EnergyTerm` over all or some of the pose variables.

    Attributes:
        likelihood: image likelihood of the body.
        terms: terms that are functions of the frames of a pose; at most one of each kind with a
            compiled kernel.
        motion: motion prior of the free variables, around the expected poses; None if missing.
        point: (d,) values of the variables, used for the fixed variables; None: all variables are
            free.
        free: (f,) indices of the variables that are free if `point` is given.
        counted: function called with the number of evaluated poses; None: not called.
        _own: terms with a compiled kernel, without the motion prior.
        _strange: terms without a compiled kernel.

    Raises:
        ValueError: two terms with a compiled kernel are of the same kind.
    """

    likelihood: ImageLikelihood
    terms: tuple[CompiledTerm | FrameTerm, ...]
    motion: Quadratic | Student | None = None
    point: Array | None = None
    free: Index | None = None
    counted: Callable[[int], None] | None = None
    _own: Compiled = field(init=False, repr=False)
    _strange: tuple[FrameTerm, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        own = tuple(x for x in self.terms if type(x) in KINDS)
        others = tuple(cast(FrameTerm, x) for x in self.terms if type(x) not in KINDS)
        object.__setattr__(self, '_own', _summed(self.likelihood, own))
        object.__setattr__(self, '_strange', others)

    def energy(
        self,
        x: Array,
        rows: Index | None = None,
        *,
        derivatives: Derivatives = Derivatives.POSITIVE,
    ) -> Energy:
        """The energy at values x (n, f) of the free variables; see `EnergyTerm`.

        If `rows` is None, point i belongs to problem i.

        Raises:
            ValueError: x does not have f columns, or is not finite.
        """
        return self._evaluated(x, rows, derivatives, apart=False)[0]

    def values(self, x: Array) -> Array:
        """The energies (n,) without derivatives; pose i belongs to problem i. See `energy`."""
        return self.energy(x, derivatives=Derivatives.NONE).value

    def by_cue(self, x: Array, *, derivatives: bool = True) -> ByCue:
        """The energy at poses x (n, d), split by cue; pose i belongs to problem i.

        Raises:
            ValueError: some variables are fixed, there is a motion prior, or `energy` would fail.
        """
        if self.point is not None or self.motion is not None:
            seen = 'a motion' if self.point is None else 'variables that are fixed'
            raise ValueError(f'by_cue wants the terms of a whole pose alone, saw {seen}')
        asked = Derivatives.POSITIVE if derivatives else Derivatives.NONE
        return ByCue(*self._evaluated(x, None, asked, apart=True))

    def _evaluated(
        self, x: Array, rows: Index | None, derivatives: Derivatives, *, apart: bool
    ) -> tuple[Energy, Array, Array, Array]:
        x = self._checked(x)
        exact = derivatives == Derivatives.EXACT
        energy, parts, *_ = self._solved(
            x, rows, NO_DESCENT, 8, exact=exact, wanted=bool(derivatives), apart=apart
        )
        if self.counted is not None:
            self.counted(len(x))
        found = energy if derivatives else Energy(energy.value)
        if not self._strange:
            return found, *parts
        others = self._others(x, np.arange(len(x)) if rows is None else rows, derivatives)
        if apart:
            for other in others:
                parts[0][:, 2] += other.value
                if derivatives:
                    parts[1][:, 2] += other.derivatives()[1]
        return add_energies([found, *others]), *parts

    def minimise(
        self,
        x: ArrayLike,
        *,
        step_scale: ArrayLike | None = None,
        damping: float = DAMPING,
        max_iterations: int = MAX_ITERATIONS,
        tolerance: float = TOLERANCE,
    ) -> Minimum:
        """Minima from starts x (n, f) within the limits of the body; see `bounded_newton.minimise`.

        Args:
            x: (n, f) initial values of the free variables.
            step_scale: (d,) or scalar length of a moderate step; None: the result of `scale_of`.
            damping, max_iterations, tolerance: as for `bounded_newton.minimise`.

        Raises:
            ValueError: x does not have f columns, or is not finite.
        """
        body = self.likelihood.body
        step_scale = scale_of(body) if step_scale is None else step_scale
        scale = np.full(body.dimension, step_scale, dtype=np.float64)
        if self._strange:
            lower, upper = _limits(body)[:, self._free]
            return minimise(
                self,
                x,
                lower,
                upper,
                step_scale=scale[self._free],
                damping=damping,
                max_iterations=max_iterations,
                tolerance=tolerance,
            )
        inside = self._checked(x)
        descent = Descent(max_iterations, float(damping), float(tolerance), scale)
        energy, _, status, iterations, moving = self._solved(inside, None, descent, 2)
        if self.counted is not None:
            self.counted(len(inside) + int(iterations.sum()))
        gradient, hessian = energy.derivatives()
        return Minimum(inside, energy.value, gradient, hessian, moving, status, iterations)

    def _solved(
        self,
        x: Array,
        rows: Index | None,
        descent: Descent,
        together: int,
        *,
        exact: bool = False,
        wanted: bool = True,
        apart: bool = False,
    ) -> tuple[
        Energy, tuple[Array, Array, Array], NDArray[np.int8], NDArray[np.int32], NDArray[np.bool_]
    ]:
        """Energies at points x (n, f), or at minima, which overwrite x; outputs as for `solve`.

        Args:
            rows: (n,) problem of each point; None: point i belongs to problem i.
            descent: settings of the minimiser; with `NO_DESCENT` the points are only evaluated.
            together: number of points that a thread processes at a time.
            wanted: whether to compute derivatives.
            apart: whether to compute values and Hessians of each cue, and outline costs.
        """
        n, f = x.shape
        asked, values = n if wanted else 0, n if apart else 0
        energy = Energy(np.empty(n), np.empty((asked, f)), np.empty((asked, f, f)))
        parts = np.empty((values, 3)), np.empty((asked if apart else 0, 3, f, f))
        status, iterations = np.empty(n, dtype=np.int8), np.zeros(n, dtype=np.int32)
        moving = np.empty((0 if descent is NO_DESCENT else n, f), dtype=np.bool_)
        compiled, costs = self._compiled, np.zeros((values, 0))
        if apart:
            compiled, costs = _with_costs(compiled, n)
        before = compiled, self._point, self._free, NO_ROWS if rows is None else rows, exact
        limits = _limits(self.likelihood.body)
        after = limits, descent, x, *energy, parts, status, iterations, moving

        def work(first: int, last: int) -> None:
            solve(first, last, *before, *after)

        in_threads(work, n, together, self.likelihood.threads)
        return energy, (*parts, costs), status, iterations, moving

    @property
    def _point(self) -> Array:
        return np.zeros(self.likelihood.body.dimension) if self.point is None else self.point

    @property
    def _free(self) -> Index:
        if self.point is None:
            return _every_variable(self.likelihood.body)
        assert self.free is not None
        return np.asarray(self.free, dtype=np.intp)

    def _checked(self, x: ArrayLike) -> Array:
        result = np.array(x, dtype=np.float64, order='C', ndmin=2)
        if result.ndim != 2 or result.shape[1] != len(self._free):
            raise ValueError(f'poses must have shape (N, {len(self._free)}), saw {result.shape}')
        return result

    def _others(self, x: Array, rows: Index, derivatives: Derivatives) -> list[Energy]:
        """Energies of the terms without a kernel, over the free variables."""
        poses = np.repeat(self._point[None], len(x), axis=0)
        poses[:, self._free] = x
        frames = forward(self.likelihood.body.skeleton, poses)
        own = np.ix_(self._free, self._free)
        result = []
        for term in self._strange:
            found = term.energy(frames, rows, derivatives=derivatives)
            if derivatives:
                slope, curve = found.derivatives()
                found = Energy(found.value, slope[:, self._free], curve[:, own[0], own[1]])
            result.append(found)
        return result

    @cached_property
    def _compiled(self) -> Compiled:
        """The terms as inputs of the core, without a buffer for outline costs."""
        known = self._own
        if self.motion is not None:
            centres, precisions, tails = _expected(self.motion)
            return known._replace(centres=centres, precisions=precisions, tails=tails)
        if self.point is None:
            return known
        f = len(self._free)
        return known._replace(centres=np.zeros((0, f)), precisions=np.zeros((0, f, f)))


# Cached because an image is compared with many sets of poses.
@lru_cache(maxsize=8)
def _summed(likelihood: ImageLikelihood, terms: tuple[CompiledTerm | FrameTerm, ...]) -> Compiled:
    """Terms with a compiled kernel, as inputs of the core.

    Raises:
        ValueError: two terms are of the same kind.
    """
    known: dict[str, Any] = {}
    for term in terms:
        name = KINDS[type(term)]
        if name in known:
            found = f'{type(known[name]).__name__} and {type(term).__name__}'
            raise ValueError(f'a sum has one term of a kind at most, saw {found}')
        known[name] = term
    image = known.pop('image', None) or observed(likelihood, NOTHING_SEEN)
    compiled = {name: term.compiled for name, term in known.items()} | image.compiled
    return _absent(likelihood.body)._replace(**compiled)


def _with_costs(compiled: Compiled, poses: int) -> tuple[Compiled, Array]:
    """The terms with a buffer for the energies (N, M) of outline samples, and the buffer itself."""
    inputs, costs = list(compiled.inputs), np.zeros((poses, 0))
    for i, own in enumerate(inputs):
        if hasattr(own, 'costs'):
            costs = np.zeros((poses, own.costs.shape[1]))
            inputs[i] = own._replace(costs=costs)
    return compiled._replace(inputs=tuple(inputs)), costs


def _expected(motion: Quadratic | Student) -> tuple[Array, Array, float]:
    """Centres, precisions and degrees of freedom of a motion prior."""
    centres, precisions = np.atleast_2d(motion.centres), motion.precisions
    if precisions.ndim == 1:
        precisions = np.diag(precisions)
    if precisions.ndim == 2:
        precisions = precisions[None]
    if len(centres) != len(precisions):
        rows, f = max(len(centres), len(precisions)), centres.shape[1]
        centres = np.broadcast_to(centres, (rows, f))
        precisions = np.broadcast_to(precisions, (rows, f, f))
    tails = motion.degrees_of_freedom if isinstance(motion, Student) else 0.0
    return (
        np.ascontiguousarray(centres, dtype=np.float64),
        np.ascontiguousarray(precisions, dtype=np.float64),
        float(tails),
    )


# Field of `Compiled` that holds the inputs of each kind of term with a compiled kernel.
KINDS: dict[type, str] = {
    ObservedImage: 'image',
    KeypointTerm: 'keypoints',
    MixturePrior: 'prior',
    AnglePrior: 'prior',
    SelfIntersection: 'overlaps',
    GroundTerm: 'ground',
    FlowTerm: 'flow',
}
NOTHING_SEEN = Observation()


@lru_cache(maxsize=16)
def _limits(body: Body) -> Array:
    """Lower and upper limits (2, d)."""
    return np.stack([body.lower, body.upper])


@lru_cache(maxsize=16)
def _every_variable(body: Body) -> Index:
    return np.arange(body.dimension)


@lru_cache(maxsize=16)
def _absent(body: Body) -> Compiled:
    """Inputs of the compiled core if all terms are absent."""
    camera = Camera(1.0, 1.0, 0.0, 0.0, 1, 1)
    none, nothing = np.zeros(0, np.int64), np.zeros((0, 0, 3))
    no_keypoints = Keypoints((), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0))
    no_floor = FloorPlane(np.zeros(3), 0.0, None, np.inf)
    no_points = SurfacePoints(none, np.zeros((0, 0), np.int64), nothing, nothing[..., :2].copy())
    d = body.dimension
    return Compiled(
        placing=placing_of(body.skeleton),
        model=ImageLikelihood(body, camera).model,
        inputs=(),
        image=False,
        contour=False,
        keypoints=KeypointTerm(body.skeleton, camera, no_keypoints).compiled,
        prior=AnglePrior(body, 0.0).compiled,
        overlaps=SelfIntersection(body, np.inf).compiled,
        ground=GroundTerm(body, GroundSettings(0.0, 0.0), no_floor).compiled,
        flow=FlowTerm(no_points, NO_MAP, 0.0).compiled,
        centres=np.zeros((0, d)),
        precisions=np.zeros((0, d, d)),
        tails=0.0,
    )
