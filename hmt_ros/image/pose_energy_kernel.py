"""The compiled energies of `pose_energy`, and the descent to their minima, pose by pose."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from hmt_ros.body.ground_kernel import Constants, add_ground_energy
from hmt_ros.body.kinematics import Placing, place_pose
from hmt_ros.body.pose_prior import PriorModel, evaluate_prior
from hmt_ros.body.self_intersection import Overlaps, add_overlaps
from hmt_ros.image.optical_flow import FlowTerm, add_flow
from hmt_ros.image.terms.keypoint_kernel import KeypointInputs, add_keypoints
from hmt_ros.image.terms.registry import Model, look, new_view, run_terms
from hmt_ros.image.terms.residuals import assemble_pose
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.bounded_newton import (
    DAMPING_LIMIT,
    LEAST_FACTOR,
    LEAST_RATIO,
    Status,
    box_step,
)

# As compiled code writes them.
_CONVERGED, _LIMIT, _STALLED, _NOT_FINITE = (
    int(status)
    for status in (
        Status.CONVERGED,
        Status.ITERATION_LIMIT,
        Status.STALLED,
        Status.NOT_FINITE,
    )
)


class Compiled(NamedTuple):
    """The terms as compiled code reads them; a term that is not there counts 0.

    Attributes:
        placing: of the skeleton.
        model, inputs: of the terms of the image.
        image, contour: whether one of these is on, and whether one that is on needs the contour.
        keypoints, prior, overlaps, ground, flow: of the other terms.
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
    flow: FlowTerm
    centres: Array
    precisions: Array
    tails: float


class Descent(NamedTuple):
    """Settings of the minimiser; see `bounded_newton.minimise`.

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


class Room(NamedTuple):
    """Working arrays for one pose.

    Attributes:
        pose: (d,).
        axes, dof_origins: (d, 3) of its degrees of freedom.
        shown: the pose as the terms of the image see it, with the frames of the segments.
        wrenches, stiffnesses: (S, 6), (S, 6, 6) sums over the segments.
        energies: (terms,) of the image.
        value: (cues,) energies: of image, keypoints and all other terms, or one of them all.
        gradient, hessian: (cues, d), (cues, d, d).
        slope, curve: (f,), (f, f) on the free variables.
    """

    pose: Array
    axes: Array
    dof_origins: Array
    shown: Any
    wrenches: Array
    stiffnesses: Array
    energies: Array
    value: Array
    gradient: Array
    hessian: Array
    slope: Array
    curve: Array


@njit(cache=True, nogil=True)
def _room(model, terms, point, f, cues):  # type: ignore[no-untyped-def]
    segments, d = len(model.tree.parents), len(point)
    return Room(
        point.copy(),
        np.empty((d, 3)),
        np.zeros((d, 3)),
        new_view(model),
        np.empty((segments, 6)),
        np.empty((segments, 6, 6)),
        np.empty(terms),
        np.empty(cues),
        np.empty((cues, d)),
        np.empty((cues, d, d)),
        np.empty(f),
        np.empty((f, f)),
    )


@njit(cache=True, nogil=True, inline='always')
def _add_terms(compiled, number, row, exact, wanted, room):  # type: ignore[no-untyped-def]
    """Energy of the pose in a room without the motion; derivatives become those of the pose.

    Args:
        compiled: the terms.
        number, row: of the pose in its call, and of its problem.
        exact: whether the Hessian of the prior is the exact one.
        wanted: whether derivatives are wanted.
        room: with the pose.
    """
    view, axes, dof_origins = room.shown, room.axes, room.dof_origins
    columns, origins = view.columns, view.origins
    value, gradient, hessian = room.value, room.gradient, room.hessian
    of_keypoints, of_others = min(1, len(value) - 1), len(value) - 1
    value[:] = 0.0
    if wanted:
        gradient[:], hessian[:] = 0.0, 0.0
    place_pose(compiled.placing, room.pose, columns, origins, axes, dof_origins)
    value[of_others] = evaluate_prior(
        compiled.prior, room.pose, exact, wanted, gradient[of_others], hessian[of_others]
    )
    if compiled.image:
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
            tree = compiled.model.tree
            assemble_pose(tree, axes, dof_origins, wrenches, stiffnesses, gradient[0], hessian[0])
    keypoints = compiled.keypoints
    if len(keypoints.points.groups) > 0 or keypoints.lifted.weight > 0.0:
        own = row if len(keypoints.log_priors) > 1 else 0
        value[of_keypoints] += add_keypoints(
            keypoints,
            keypoints.log_priors[own],
            columns,
            origins,
            axes,
            dof_origins,
            wanted,
            gradient[of_keypoints],
            hessian[of_keypoints],
        )
    known, slope, curve = value[of_others:], gradient[of_others], hessian[of_others]
    if compiled.overlaps.sigma < np.inf:
        add_overlaps(
            compiled.overlaps, columns, origins, axes, dof_origins, wanted, known, slope, curve
        )
    if compiled.ground.weights.sum() > 0.0:
        known[0] += add_ground_energy(
            compiled.ground, columns, origins, axes, dof_origins, wanted, slope, curve
        )
    if compiled.flow.weight > 0.0:
        add_flow(
            compiled.flow,
            compiled.model.tree,
            compiled.model.lens,
            row,
            columns,
            origins,
            axes,
            dof_origins,
            wanted,
            known,
            slope,
            curve,
        )
    return value.sum()


@njit(cache=True, nogil=True)
def _add_motion(centre, precision, nu, x, slope, curve):  # type: ignore[no-untyped-def]
    """Energy of the motion at x (f,); its derivatives are added to slopes (f,), where wanted."""
    f = len(x)
    pulled = np.zeros(f)
    for j in range(f):  # along rows of a symmetric matrix: so the compiler takes many at once
        moved = x[j] - centre[j]
        for i in range(f):
            pulled[i] += precision[j, i] * moved
    distance = 0.0
    for i in range(f):
        distance += pulled[i] * (x[i] - centre[i])
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
        room.pose[free[i]] = x[i]
    value = _add_terms(compiled, number, row, exact, len(slope) > 0, room)
    if len(slope) > 0:
        for i in range(f):
            slope[i] = room.gradient[0, free[i]]
            for j in range(f):
                curve[i, j] = room.hessian[0, free[i], free[j]]
        for cue in range(1, len(room.value)):
            for i in range(f):
                slope[i] += room.gradient[cue, free[i]]
                for j in range(f):
                    curve[i, j] += room.hessian[cue, free[i], free[j]]
    if len(compiled.centres) > 0:
        own = row if len(compiled.centres) > 1 else 0
        value += _add_motion(
            compiled.centres[own], compiled.precisions[own], compiled.tails, x, slope, curve
        )
    return value


@njit(cache=True, nogil=True, error_model='numpy')
def solve(  # type: ignore[no-untyped-def]
    first,
    last,
    compiled,
    point,
    free,
    rows,
    exact,
    limits,
    descent,
    x,
    value,
    gradient,
    hessian,
    by_cue,
    status,
    iterations,
):
    """Energies at the points first to last - 1, or minima from there.

    One function for both: a function that calls the kernels of all terms takes long to compile.

    Args:
        first, last: range of points.
        compiled, point, free, rows, exact: as for `PoseEnergy.energy`.
        limits: (2, f) lower and upper ones.
        descent: settings as for `bounded_newton.minimise`.
        x: (n, f) points; become minima, where iterations are asked for.
        value, gradient, hessian: (n,), (n, f), (n, f, f) result; of no point: no derivatives are
            wanted, and no minima.
        by_cue: energies (n, 3) and Hessians (n, 3, d, d) of image, keypoints and all other terms,
            result; of no point: not wanted. They are those of the last evaluation, all variables
            are free, and Hessians only where derivatives are.
        status, iterations: (n,) results.
    """
    f, apart = len(free), len(by_cue[0]) > 0
    room = _room(compiled.model, len(compiled.inputs), point, f, 3 if apart else 1)
    slope, curve = room.slope, room.curve
    low, high, step, trial, scratch = (
        np.empty(f),
        np.empty(f),
        np.empty(f),
        np.empty(f),
        np.empty(f),
    )
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
                compiled,
                n,
                rows[n],
                free,
                trial,
                exact,
                room,
                slope if wanted else slope[:0],
                curve,
            )
            if apart:
                by_cue[0][n] = room.value
                if wanted:
                    by_cue[1][n] = room.hessian
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
