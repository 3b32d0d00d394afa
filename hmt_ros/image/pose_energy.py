"""Energies of poses and their minima, compiled as a whole: all terms of one image in one pass.

    E(x) = E_image(x) + E_keypoints(x) + E_prior(x) + E_intersection(x) + E_ground(x) + E_motion(x)

A pose is placed once, and the kernels of all terms that it is compared by read its frames. The
minima are those of `inference.bounded_newton`, problem by problem instead of step by step. A term
without a kernel here is added by its own `energy`; then the minima are found step by step, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from hmt_ros.body.ground_kernel import Constants, add_ground_energies
from hmt_ros.body.ground_terms import GroundTerm
from hmt_ros.body.kinematics import Placing, forward, place_pose, placing_of
from hmt_ros.body.pose_prior import MixturePrior, PriorModel, evaluate_prior, gaussian_model
from hmt_ros.body.pose_terms import AnglePrior, FrameTerm, SelfIntersection
from hmt_ros.body.self_intersection import Overlaps, add_overlaps, overlaps_of
from hmt_ros.image.likelihood import ImageLikelihood, ObservedImage, in_threads
from hmt_ros.image.observation import Observation
from hmt_ros.image.terms.keypoint_kernel import KeypointInputs, Points, Slopes, add_keypoints
from hmt_ros.image.terms.keypoints import KeypointTerm
from hmt_ros.image.terms.registry import TERMS, Model, look, new_view, run_terms
from hmt_ros.image.terms.residuals import assemble_pose
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import (
    DAMPING_LIMIT,
    LEAST_FACTOR,
    Minimum,
    box_step,
    minimise,
    resting,
)
from hmt_ros.inference.energy import Derivatives, Energy, Quadratic, Student, add_energies
from hmt_ros.inference.trust_region import LEAST_RATIO, Status

# As compiled code writes them.
_CONVERGED, _LIMIT, _STALLED, _NOT_FINITE = (
    int(status)
    for status in (
        Status.CONVERGED, Status.ITERATION_LIMIT, Status.STALLED, Status.NOT_FINITE,
    )
)  # fmt: skip


class Compiled(NamedTuple):
    """The terms as compiled code reads them; what is not there counts 0.

    Attributes:
        placing: of the skeleton.
        model, inputs: of the terms of the image.
        image, contour: whether one of these is on, and whether one that is on needs the contour.
        keypoints, prior, overlaps, ground: of the other terms.
        centres, precisions: (R, f), (R, f, f) of the motion, a row a problem or one for all; no
            rows: there is none.
        tails: its degrees of freedom; 0: it is Gaussian.
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
    centres: Array
    precisions: Array
    tails: float


Term = TypeVar('Term')


class Descent(NamedTuple):
    """What minima are found by; see `bounded_newton.minimise`.

    Attributes:
        most: evaluations per problem after the first one.
        damping, tolerance: first lambda, and gain of a step that ends a descent.
        metric: (f,) diagonal of W.
    """

    most: int
    damping: float
    tolerance: float
    metric: Array


NO_DESCENT = Descent(0, 1.0, 0.0, np.zeros(0))


@dataclass(frozen=True, eq=False)
class PoseEnergy:
    """A sum of terms over the poses of a body; an `EnergyTerm` over all variables, or some.

    Attributes:
        likelihood: of the body before the camera.
        terms: that read the frames of a pose, at most one of each kind that has a kernel.
        motion: around where poses are expected, over the free variables; None: nothing is expected.
        point: (d,) values of all variables; None: all are free.
        free: (f,) variables that may move, where there is a point.
        counted: is told how many poses have been evaluated.

    Raises:
        ValueError: two terms of one kind that has a kernel.
    """

    likelihood: ImageLikelihood
    terms: tuple[FrameTerm, ...]
    motion: Quadratic | Student | None = None
    point: Array | None = None
    free: Index | None = None
    counted: Callable[[int], None] | None = None

    def __post_init__(self) -> None:
        for kind in _KNOWN:
            found = [type(term).__name__ for term in self.terms if isinstance(term, kind)]
            if len(found) > 1:
                raise ValueError(f'a sum has one term of a kind at most, saw {" and ".join(found)}')

    def energy(
        self,
        x: Array,
        rows: Index | None = None,
        *,
        derivatives: Derivatives = Derivatives.POSITIVE,
    ) -> Energy:
        """The energy at values x (n, f) of the free variables; see `EnergyTerm`.

        Without rows, point i belongs to problem i.

        Raises:
            ValueError: x has not f columns, or is not finite.
        """
        x = self._checked(x)
        n, f = x.shape
        rows = np.arange(n) if rows is None else np.asarray(rows, dtype=np.intp)
        compiled, asked = self._compiled(n), n if derivatives else 0
        value, gradient, hessian = np.empty(n), np.empty((asked, f)), np.empty((asked, f, f))
        exact = derivatives == Derivatives.EXACT
        limits, nothing = np.zeros((2, f)), (np.empty(n, np.int8), np.zeros(n, np.int32))

        def work(first: int, last: int) -> None:
            _solve(
                first, last, compiled, self._point, self._free, rows, exact, limits, NO_DESCENT,
                x, value, gradient, hessian, *nothing,
            )  # fmt: skip

        in_threads(work, n, 8, self.likelihood.threads)
        if self.counted is not None:
            self.counted(n)
        found = Energy(value, gradient, hessian) if derivatives else Energy(value)
        return add_energies([found, *self._others(x, rows, derivatives)])

    def minimise(
        self,
        x: ArrayLike,
        *,
        step_scale: ArrayLike,
        damping: float,
        max_iterations: int,
        tolerance: float,
    ) -> Minimum:
        """Minima from starts x (n, f) within the limits of the body; see `bounded_newton.minimise`.

        Raises:
            ValueError: x has not f columns, or is not finite.
        """
        body = self.likelihood.body
        lower, upper = body.lower[self._free], body.upper[self._free]
        if self._strange:
            return minimise(
                self, x, lower, upper, step_scale=step_scale, damping=damping,
                max_iterations=max_iterations, tolerance=tolerance,
            )  # fmt: skip
        x = np.clip(self._checked(x), lower, upper)
        n, f = x.shape
        metric = np.broadcast_to(np.asarray(step_scale, dtype=np.float64) ** -2.0, (f,)).copy()
        descent = Descent(max_iterations, float(damping), float(tolerance), metric)
        limits, rows = np.stack([lower, upper]), np.arange(n)
        compiled = self._compiled(n)
        value, gradient, hessian = np.empty(n), np.empty((n, f)), np.empty((n, f, f))
        status, iterations = np.empty(n, dtype=np.int8), np.zeros(n, dtype=np.int32)

        def work(first: int, last: int) -> None:
            _solve(
                first, last, compiled, self._point, self._free, rows, False, limits, descent, x,
                value, gradient, hessian, status, iterations,
            )  # fmt: skip

        in_threads(work, n, 4, self.likelihood.threads)
        if self.counted is not None:
            self.counted(n + int(iterations.sum()))
        free = ~resting(x, gradient, lower, upper)
        return Minimum(x, value, gradient, hessian, free, status, iterations)

    @cached_property
    def _point(self) -> Array:
        if self.point is None:
            return np.zeros(self.likelihood.body.dimension)
        return np.array(self.point, dtype=np.float64)

    @cached_property
    def _free(self) -> Index:
        if self.point is None:
            return np.arange(self.likelihood.body.dimension)
        assert self.free is not None
        return np.asarray(self.free, dtype=np.intp)

    def _checked(self, x: ArrayLike) -> Array:
        result = np.array(x, dtype=np.float64, ndmin=2)
        if result.ndim != 2 or result.shape[1] != len(self._free):
            wanted = f'(N, {len(self._free)})'
            raise ValueError(f'poses must have shape {wanted}, saw {result.shape}')
        if not np.isfinite(result).all():
            raise ValueError('poses must be finite')
        return result

    @cached_property
    def _strange(self) -> tuple[FrameTerm, ...]:
        """Terms without a kernel here."""
        return tuple(x for x in self.terms if not any(isinstance(x, kind) for kind in _KNOWN))

    def _others(self, x: Array, rows: Index, derivatives: Derivatives) -> list[Energy]:
        """Energies of the terms without a kernel, over the free variables."""
        if not self._strange:
            return []
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

    def _compiled(self, count: int) -> Compiled:
        """The terms as compiled code reads them, for so many poses."""
        image = self._term(ObservedImage)
        likelihood = self.likelihood if image is None else image.likelihood
        observation = NOTHING_SEEN if image is None else image.observation
        inputs = likelihood.inputs(observation, count, None if image is None else image.explained)
        running = [bool(one.term.weight > 0) for one in inputs]
        contour = any(on and term.needs_contour for on, term in zip(running, TERMS, strict=True))
        return Compiled(
            inputs=inputs, image=any(running), contour=contour, model=likelihood.model, **self._rest
        )

    @cached_property
    def _rest(self) -> dict[str, Any]:
        """What compiled code reads besides the terms of the image."""
        body = self.likelihood.body
        keypoints, overlaps = self._term(KeypointTerm), self._term(SelfIntersection)
        ground, mixture = self._term(GroundTerm), self._term(MixturePrior)
        angles = self._term(AnglePrior)
        prior = gaussian_model(body, 0.0 if angles is None else angles.weight)
        detected = _no_keypoints(self.likelihood) if keypoints is None else keypoints.compiled
        centres, precisions, tails = self._expected
        return {
            'placing': placing_of(body.skeleton),
            'keypoints': detected,
            'prior': prior if mixture is None else mixture.compiled,
            'overlaps': overlaps_of(body, np.inf if overlaps is None else overlaps.sigma),
            'ground': _no_ground(body.dimension) if ground is None else ground.compiled,
            'centres': centres,
            'precisions': precisions,
            'tails': tails,
        }

    def _term(self, kind: type[Term]) -> Term | None:
        return next((term for term in self.terms if isinstance(term, kind)), None)

    @cached_property
    def _expected(self) -> tuple[Array, Array, float]:
        """Centres, precisions and degrees of freedom of the motion."""
        f = len(self._free)
        if self.motion is None:
            return np.zeros((0, f)), np.zeros((0, f, f)), 0.0
        centres, precisions = np.atleast_2d(self.motion.centres), self.motion.precisions
        if precisions.ndim == 1:
            precisions = np.diag(precisions)
        if precisions.ndim == 2:
            precisions = precisions[None]
        rows = max(len(centres), len(precisions))
        tails = self.motion.degrees_of_freedom if isinstance(self.motion, Student) else 0.0
        return (
            np.array(np.broadcast_to(centres, (rows, f)), dtype=np.float64),
            np.array(np.broadcast_to(precisions, (rows, f, f)), dtype=np.float64),
            float(tails),
        )


# Kinds of terms with a kernel here.
_KNOWN: tuple[Any, ...] = (
    ObservedImage, KeypointTerm, (MixturePrior, AnglePrior), SelfIntersection, GroundTerm,
)  # fmt: skip
NOTHING_SEEN = Observation()


def _no_keypoints(likelihood: ImageLikelihood) -> KeypointInputs:
    none, pairs = np.zeros(0, dtype=np.int64), np.zeros((0, 2), dtype=np.int64)
    return KeypointInputs(
        Points(pairs, np.zeros((0, 2, 3)), np.zeros((0, 2)), np.zeros((0, 2, 2)), none),
        Slopes(
            pairs, np.zeros((0, 2, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), none
        ),
        likelihood.model.tree, likelihood.model.lens, 1.0, np.zeros(1),
        np.zeros((1, 1), dtype=np.int64), np.zeros((1, 1)),
    )  # fmt: skip


@lru_cache(maxsize=16)
def _no_ground(dimension: int) -> Constants:
    none, nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    return Constants(
        np.zeros(dimension, dtype=np.bool_), np.zeros((0, dimension), dtype=np.bool_), np.zeros(2),
        np.zeros(3), 0.0, none, np.zeros((0, 3, 3)), nothing, none, nothing, 0.0, 1.0, 1.0,
    )  # fmt: skip


class Room(NamedTuple):
    """Where one pose is worked on.

    Attributes:
        pose: (1, d).
        columns, origins: (1, S, 3, 3), (1, S, 3) frames of its segments.
        axes, dof_origins: (1, d, 3) of its degrees of freedom.
        shown: the pose as the terms of the image see it.
        wrenches, stiffnesses: (S, 6), (S, 6, 6) sums over the segments.
        energies: (terms,) of the image.
        value, ground: (1,), (1, 2).
        gradient, hessian: (1, d), (1, d, d).
        slope, curve: (f,), (f, f) on the free variables.
    """

    pose: Array
    columns: Array
    origins: Array
    axes: Array
    dof_origins: Array
    shown: Any
    wrenches: Array
    stiffnesses: Array
    energies: Array
    value: Array
    ground: Array
    gradient: Array
    hessian: Array
    slope: Array
    curve: Array


@njit(cache=True, nogil=True)
def _room(compiled, point, f):  # type: ignore[no-untyped-def]
    segments, d = len(compiled.placing.parents), len(point)
    room = Room(
        np.empty((1, d)), np.empty((1, segments, 3, 3)), np.empty((1, segments, 3)),
        np.empty((1, d, 3)), np.zeros((1, d, 3)),
        new_view(compiled.model),
        np.empty((segments, 6)), np.empty((segments, 6, 6)), np.empty(len(compiled.inputs)),
        np.empty(1), np.empty((1, 2)), np.empty((1, d)), np.empty((1, d, d)), np.empty(f),
        np.empty((f, f)),
    )  # fmt: skip
    room.pose[0] = point
    return room


@njit(cache=True, nogil=True, inline='always')
def _add_terms(compiled, number, row, exact, room, gradient, hessian):  # type: ignore[no-untyped-def]
    """Energy of the pose in a room without the motion.

    Args:
        compiled: the terms.
        number, row: of the pose in its call, and of its problem.
        exact: whether the Hessian of the prior is the exact one.
        room: with the pose.
        gradient, hessian: (1, d), (1, d, d) result; of no pose: not wanted.
    """
    columns, origins, axes, dof_origins = room.columns, room.origins, room.axes, room.dof_origins
    value, wanted = room.value, len(gradient) > 0
    place_pose(compiled.placing, room.pose[0], columns[0], origins[0], axes[0], dof_origins[0])
    evaluate_prior(compiled.prior, room.pose, exact, value, gradient, hessian)
    if compiled.image:
        view = room.shown
        view.columns[:], view.origins[:] = columns[0], origins[0]
        look(view, number, compiled.contour)
        room.energies[:] = 0.0
        wrenches, stiffnesses = room.wrenches, room.stiffnesses
        if not wanted:
            wrenches, stiffnesses = wrenches[:0], stiffnesses[:0]
        wrenches[:] = 0.0
        stiffnesses[:] = 0.0
        run_terms(view, compiled.inputs, 0, room.energies, wrenches, stiffnesses)
        value[0] += room.energies.sum()
        if wanted:
            assemble_pose(
                compiled.model.tree, axes[0], dof_origins[0], wrenches, stiffnesses, gradient[0],
                hessian[0],
            )  # fmt: skip
    keypoints = compiled.keypoints
    if len(keypoints.points.groups) + len(keypoints.slopes.groups) > 0:
        own = row if len(keypoints.log_priors) > 1 else 0
        add_keypoints(
            keypoints, keypoints.log_priors[own : own + 1], columns, origins, axes, dof_origins,
            value, gradient, hessian,
        )  # fmt: skip
    if compiled.overlaps.sigma < np.inf:
        add_overlaps(
            compiled.overlaps, columns, origins, axes, dof_origins, value, gradient, hessian
        )
    if compiled.ground.weights.sum() > 0.0:
        room.ground[:] = 0.0
        add_ground_energies(
            compiled.ground, columns, origins, axes, dof_origins, room.ground, gradient, hessian
        )
        value[0] += room.ground.sum()
    return value[0]


@njit(cache=True, nogil=True)
def _add_motion(compiled, row, x, slope, curve):  # type: ignore[no-untyped-def]
    """Energy of the motion at x (f,); its derivatives are added to slopes (f,), where wanted."""
    f = len(x)
    own = row if len(compiled.centres) > 1 else 0
    centre, precision, nu = compiled.centres[own], compiled.precisions[own], compiled.tails
    pulled = np.empty(f)
    distance = 0.0
    for i in range(f):
        total = 0.0
        for j in range(f):
            total += precision[i, j] * (x[j] - centre[j])
        pulled[i] = total
        distance += total * (x[i] - centre[i])
    value, shrinkage = 0.5 * distance, 1.0
    if nu > 0.0:
        value = 0.5 * (nu + f) * np.log1p(distance / nu)
        shrinkage = (nu + f) / (nu + distance)
    if len(slope) > 0:
        for i in range(f):
            slope[i] += shrinkage * pulled[i]
            for j in range(f):
                curve[i, j] += shrinkage * precision[i, j]
    return value


@njit(cache=True, nogil=True, inline='always')
def _energy_at(compiled, number, row, free, x, exact, room, slope, curve):  # type: ignore[no-untyped-def]
    """Energy of all terms at x (f,); slope and curve (f,), (f, f) become its derivatives.

    No slopes: no derivatives are wanted.
    """
    f = len(free)
    for i in range(f):
        room.pose[0, free[i]] = x[i]
    count = 1 if len(slope) > 0 else 0
    gradient, hessian = room.gradient[:count], room.hessian[:count]
    value = _add_terms(compiled, number, row, exact, room, gradient, hessian)
    if count > 0:
        for i in range(f):
            slope[i] = gradient[0, free[i]]
            for j in range(f):
                curve[i, j] = hessian[0, free[i], free[j]]
    if len(compiled.centres) > 0:
        value += _add_motion(compiled, row, x, slope, curve)
    return value


@njit(cache=True, nogil=True, error_model='numpy')
def _solve(  # type: ignore[no-untyped-def]
    first, last, compiled, point, free, rows, exact, limits, descent, x, value, gradient, hessian,
    status, iterations,
):  # fmt: skip
    """Energies at the points first to last - 1, or minima from there.

    One function for both: whatever calls the kernels of all terms takes long to compile.

    Args:
        first, last: range of points.
        compiled, point, free, rows, exact: as for `PoseEnergy.energy`.
        limits: (2, f) lower and upper ones.
        descent: what `bounded_newton.minimise` descends by.
        x: (n, f) points; become minima, where iterations are asked for.
        value, gradient, hessian: (n,), (n, f), (n, f, f) result; of no point: no derivatives are
            wanted, and no minima.
        status, iterations: (n,) results.
    """
    f = len(free)
    room = _room(compiled, point, f)
    slope, curve = room.slope, room.curve
    low, high, step, trial, scratch = (
        np.empty(f), np.empty(f), np.empty(f), np.empty(f), np.empty(f),
    )  # fmt: skip
    lower, upper = limits[0], limits[1]
    wanted = len(gradient) > 0
    for n in range(first, last):
        found, ended = 0.0, False
        shift, growth = descent.damping, 2.0
        status[n] = _LIMIT
        for turn in range(descent.most + 1):
            if turn == 0:
                trial[:] = x[n]
            else:
                for i in range(f):
                    low[i], high[i] = lower[i] - x[n, i], upper[i] - x[n, i]
                predicted = box_step(
                    gradient[n], hessian[n], low, high, shift, descent.metric, step, scratch
                )
                if predicted < descent.tolerance:
                    status[n] = _CONVERGED
                    break
                for i in range(f):
                    # Rounding must not leave a variable a hair away from its limit.
                    if step[i] <= low[i]:
                        trial[i] = lower[i]
                    elif step[i] >= high[i]:
                        trial[i] = upper[i]
                    else:
                        trial[i] = min(max(x[n, i] + step[i], lower[i]), upper[i])
            found = _energy_at(
                compiled, n, rows[n], free, trial, exact, room, slope if wanted else slope[:0],
                curve,
            )  # fmt: skip
            if turn == 0:
                better = True
                ended = not np.isfinite(found)
            else:
                iterations[n] += 1
                ratio = (value[n] - found) / predicted if np.isfinite(found) else -np.inf
                better = ratio > LEAST_RATIO
                if better:
                    shift *= max(LEAST_FACTOR, 1.0 - (2.0 * min(ratio, 2.0) - 1.0) ** 3)
                    growth = 2.0
                else:
                    shift *= growth
                    growth *= 2.0
                    ended = shift > DAMPING_LIMIT
            if better:
                x[n], value[n] = trial, found
                if wanted:
                    gradient[n], hessian[n] = slope, curve
            if ended:
                status[n] = _NOT_FINITE if turn == 0 else _STALLED
                break
