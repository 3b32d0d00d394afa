"""Energies of poses and their minima, compiled as a whole: all terms of one image in one pass.

    E(x) = E_image(x) + E_keypoints(x) + E_prior(x) + E_intersection(x) + E_ground(x) + E_flow(x)
           + E_motion(x)

A pose is placed once, and the kernels of all terms that it is compared by read its frames. The
minima are those of `inference.bounded_newton`, problem by problem instead of step by step. A term
without a kernel here is added by its own `energy`; then the minima are found step by step, too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.body import Body
from hmt_ros.body.ground_kernel import Constants
from hmt_ros.body.ground_terms import GroundTerm
from hmt_ros.body.kinematics import forward, placing_of
from hmt_ros.body.pose_prior import MixturePrior, gaussian_model
from hmt_ros.body.pose_terms import AnglePrior, FrameTerm, SelfIntersection
from hmt_ros.body.self_intersection import overlaps_of
from hmt_ros.image.likelihood import ImageLikelihood, ObservedImage
from hmt_ros.image.observation import Observation
from hmt_ros.image.optical_flow import FlowInputs, FlowTerm
from hmt_ros.image.pose_energy_kernel import NO_DESCENT, Compiled, Descent, solve
from hmt_ros.image.surface_points import SurfacePoints
from hmt_ros.image.terms.image_term import NO_MAP
from hmt_ros.image.terms.keypoint_kernel import KeypointInputs, Points
from hmt_ros.image.terms.keypoints import NOT_LIFTED, KeypointTerm
from hmt_ros.image.terms.registry import TERMS, Model
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.bounded_newton import Minimum, minimise, resting
from hmt_ros.inference.energy import Derivatives, Energy, Quadratic, Student, add_energies
from hmt_ros.inference.threads import in_threads

Term = TypeVar('Term')

# Length of a moderate step of an angle, rad, and of a place, m.
ROTATION_STEP, PLACE_STEP = 0.4, 0.3
# First damping of a minimisation, and gain by a step below which a minimum is found, nats.
DAMPING, TOLERANCE = 1.0, 1e-3
# Maximum number of steps of a minimisation that is not limited otherwise.
MAX_ITERATIONS = 40


def scale_of(body: Body) -> Array:
    """Length (d,) of a moderate step of each variable, rad or m."""
    return np.where(body.skeleton.dof_is_rotation, ROTATION_STEP, PLACE_STEP)


@dataclass(frozen=True, eq=False)
class ByCue:
    """Energies of n poses by source: image, keypoints, and all other terms.

    Attributes:
        energy: sum of all.
        values: (n, 3).
        gradients, hessians: (n, 3, d), (n, 3, d, d); of no pose: not asked for.
        outline_costs: (n, M) energy of each sample of the silhouette's outline.
    """

    energy: Energy
    values: Array
    gradients: Array
    hessians: Array
    outline_costs: Array


@dataclass(frozen=True, eq=False)
class PoseEnergy:
    """A sum of terms over the poses of a body; an `EnergyTerm` over all variables, or some.

    Attributes:
        likelihood: of the body before the camera.
        terms: that read the frames of a pose, at most one of each kind that has a kernel.
        motion: around where poses are expected, over the free variables; None: nothing is expected.
        point: (d,) values of all variables; None: all are free.
        free: (f,) variables that may move, where there is a point.
        counted: called with the number of poses that were evaluated; None: not called.

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
        return self._evaluated(x, rows, derivatives, apart=False)[0]

    def by_cue(self, x: Array, *, derivatives: bool = True) -> ByCue:
        """The energy at poses x (n, d), cue by cue; pose i belongs to problem i.

        Raises:
            ValueError: some variables are fixed, there is a motion, or x is not as for `energy`.
        """
        if self.point is not None or self.motion is not None:
            seen = 'a motion' if self.point is None else 'variables that are fixed'
            raise ValueError(f'by_cue wants the terms of a whole pose alone, saw {seen}')
        asked = Derivatives.POSITIVE if derivatives else Derivatives.NONE
        energy, parts, compiled = self._evaluated(x, None, asked, apart=True)
        costs = next((y.costs for y in compiled.inputs if hasattr(y, 'costs')), None)
        return ByCue(energy, *parts, np.zeros((len(x), 0)) if costs is None else costs)

    def _evaluated(
        self, x: Array, rows: Index | None, derivatives: Derivatives, *, apart: bool
    ) -> tuple[Energy, tuple[Array, Array, Array], Compiled]:
        x = self._checked(x)
        n, f = x.shape
        rows = np.arange(n) if rows is None else np.asarray(rows, dtype=np.intp)
        compiled, asked = self._compiled(n), n if derivatives else 0
        value, gradient, hessian = np.empty(n), np.empty((asked, f)), np.empty((asked, f, f))
        parts = _empty_parts(n if apart else 0, asked if apart else 0, f)
        exact = derivatives == Derivatives.EXACT
        limits, nothing = np.zeros((2, f)), (np.empty(n, np.int8), np.zeros(n, np.int32))

        def work(first: int, last: int) -> None:
            solve(
                first,
                last,
                compiled,
                self._point,
                self._free,
                rows,
                exact,
                limits,
                NO_DESCENT,
                x,
                value,
                gradient,
                hessian,
                parts,
                *nothing,
            )

        in_threads(work, n, 8, self.likelihood.threads)
        if self.counted is not None:
            self.counted(n)
        found = Energy(value, gradient, hessian) if derivatives else Energy(value)
        others = self._others(x, rows, derivatives)
        if apart:
            for other in others:
                parts[0][:, 2] += other.value
                if derivatives:
                    for known, own in zip(parts[1:], other.derivatives(), strict=True):
                        known[:, 2] += own
        return add_energies([found, *others]), parts, compiled

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
            x: starts.
            step_scale: (f,) or a scalar; None: that of the body.
            damping, max_iterations, tolerance: as for `bounded_newton.minimise`.

        Raises:
            ValueError: x has not f columns, or is not finite.
        """
        body = self.likelihood.body
        if step_scale is None:
            step_scale = scale_of(body)[self._free]
        lower, upper = body.lower[self._free], body.upper[self._free]
        if self._strange:
            return minimise(
                self,
                x,
                lower,
                upper,
                step_scale=step_scale,
                damping=damping,
                max_iterations=max_iterations,
                tolerance=tolerance,
            )
        x = np.clip(self._checked(x), lower, upper)
        n, f = x.shape
        metric = np.broadcast_to(np.asarray(step_scale, dtype=np.float64) ** -2.0, (f,)).copy()
        descent = Descent(max_iterations, float(damping), float(tolerance), metric)
        limits, rows = np.stack([lower, upper]), np.arange(n)
        compiled = self._compiled(n)
        value, gradient, hessian = np.empty(n), np.empty((n, f)), np.empty((n, f, f))
        status, iterations = np.empty(n, dtype=np.int8), np.zeros(n, dtype=np.int32)
        parts = _empty_parts(0, 0, f)

        def work(first: int, last: int) -> None:
            solve(
                first,
                last,
                compiled,
                self._point,
                self._free,
                rows,
                False,
                limits,
                descent,
                x,
                value,
                gradient,
                hessian,
                parts,
                status,
                iterations,
            )

        in_threads(work, n, 2, self.likelihood.threads)
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
        # A copy, which can be written: compiled code is the same for all.
        return np.array(self.free, dtype=np.intp)

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
        """Inputs of compiled code besides the terms of the image."""
        body = self.likelihood.body
        keypoints, overlaps = self._term(KeypointTerm), self._term(SelfIntersection)
        ground, mixture = self._term(GroundTerm), self._term(MixturePrior)
        angles, flow = self._term(AnglePrior), self._term(FlowTerm)
        detected = _no_keypoints(self.likelihood.model) if keypoints is None else keypoints.compiled
        if mixture is None:
            prior = gaussian_model(body, 0.0 if angles is None else angles.weight)
        else:
            prior = mixture.compiled
        centres, precisions, tails = self._expected
        return {
            'placing': placing_of(body.skeleton),
            'keypoints': detected,
            'prior': prior,
            'overlaps': overlaps_of(body, np.inf if overlaps is None else overlaps.sigma),
            'ground': _no_ground(body.dimension) if ground is None else ground.compiled,
            'flow': _NO_FLOW if flow is None else flow.compiled,
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


def _empty_parts(values: int, derivatives: int, d: int) -> tuple[Array, Array, Array]:
    return np.empty((values, 3)), np.empty((derivatives, 3, d)), np.empty((derivatives, 3, d, d))


# Kinds of terms with a kernel here.
_KNOWN: tuple[Any, ...] = (
    ObservedImage,
    KeypointTerm,
    (MixturePrior, AnglePrior),
    SelfIntersection,
    GroundTerm,
    FlowTerm,
)
NOTHING_SEEN = Observation()
_NONE, _NO_PAIRS = np.zeros(0, dtype=np.int64), np.zeros((0, 2), dtype=np.int64)
_NO_POINTS = Points(_NO_PAIRS, np.zeros((0, 2, 3)), np.zeros((0, 2)), np.zeros((0, 2, 2)), _NONE)
_NO_FLOW = FlowInputs(
    SurfacePoints(_NONE, np.zeros((0, 0), np.int64), np.zeros((0, 0, 3)), np.zeros((0, 0, 2))),
    NO_MAP,
    0.0,
)
_AS_CALLED = np.zeros((1, 1), dtype=np.int64)
_ONE, _SURE = np.zeros(1), np.zeros((1, 1))


def _no_keypoints(model: Model) -> KeypointInputs:
    return KeypointInputs(
        _NO_POINTS, NOT_LIFTED, model.tree, model.lens, 1.0, _ONE, _AS_CALLED, _SURE
    )


@lru_cache(maxsize=16)
def _no_ground(dimension: int) -> Constants:
    none, nothing = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    return Constants(
        np.zeros(dimension, dtype=np.bool_),
        np.zeros((0, dimension), dtype=np.bool_),
        np.zeros(2),
        np.zeros(3),
        0.0,
        none,
        np.zeros((0, 3, 3)),
        nothing,
        none,
        nothing,
        0.0,
        1.0,
        1.0,
    )
