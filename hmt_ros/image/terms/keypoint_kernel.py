"""Keypoints, compiled: energies of all exchanges of sides, then gradient and Hessian of the sum.

    E(x) = -log sum_e p_e exp(-sum_g E_g,e(x))          e: exchange, g: group of landmarks

Given an exchange of sides, the energies of groups add; over the exchanges, likelihoods add. The
energy of the whole pose by a mixture over depths (`lifted_poses`) is added to those of the groups.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.image.surface import Lens, project
from hmt_ros.image.terms.residuals import Tree, add_residual, assemble_pose, geman_mcclure
from hmt_ros.inference.arrays import Array

# A joint behind the camera errs by this much, in standard deviations.
BEHIND = 1e3

Ints = NDArray[np.int64]


class Points(NamedTuple):
    """Keypoints (P,), each with its landmark, and its landmark if sides are exchanged.

    Attributes:
        segments: (P, 2) that carry the landmarks.
        offsets: (P, 2, 3) of the landmarks in the frames of the segments, m.
        pixels: (P, 2).
        whiteners: (P, 2, 2) W, W' W is the precision.
        groups: (P,) that are exchanged together.
    """

    segments: Ints
    offsets: Array
    pixels: Array
    whiteners: Array
    groups: Ints


class Lifted(NamedTuple):
    """Depths of joints (J,) behind the middle of the hips, a mixture of C components.

    Attributes:
        segments: (J,) that carry the joints.
        offsets: (J, 3) of the joints in the frames of the segments, m.
        middle: (3,) middle of the hips in the frame of the root, m.
        ray: (3,) line of sight, unit vector.
        log_weights: (C,) with the normalisers of the components.
        depths: (2, C, J) along the ray from the middle of the hips, m, as the sides are called and
            exchanged.
        precisions: (2, C, J) square roots, 1/m.
        readings: (E,) 0 or 1: how an exchange of sides reads the mixture.
        weight: factor on the energy; 0: there is no mixture.
        scale: of the kernel, in standard deviations; it bounds the energy of a joint.
    """

    segments: Ints
    offsets: Array
    middle: Array
    ray: Array
    log_weights: Array
    depths: Array
    precisions: Array
    readings: Ints
    weight: float
    scale: float


class KeypointInputs(NamedTuple):
    """Inputs of the energy of keypoints.

    Attributes:
        points: that were measured.
        lifted: the mixture over whole poses.
        tree, lens: skeleton and camera.
        scale: of the kernel, in standard deviations.
        weights: (G,) factors on the energies of the groups.
        exchanged: (E, G) 1 where an exchange exchanges a group.
        log_priors: (R, E) of the exchanges, a row a problem or one for all.
    """

    points: Points
    lifted: Lifted
    tree: Tree
    lens: Lens
    scale: float
    weights: Array
    exchanged: Ints
    log_priors: Array


@njit(cache=True, nogil=True, error_model='numpy')
def point_residual(  # type: ignore[no-untyped-def]
    segments, offsets, k, e, lens, columns, origins, pixels, projections, place
):
    """Position of the landmark of keypoint k in exchange e into `place`; whether it has a pixel."""
    s = segments[k, e]
    for i in range(3):
        place[i] = origins[s, i]
        for j in range(3):
            place[i] += columns[s, j, i] * offsets[k, e, j]
    return project(lens, place[0], place[1], place[2], 0, pixels, projections)


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def whitened_error(whiteners, seen, k, i, pixels):  # type: ignore[no-untyped-def]
    """Component i of the error of keypoint k whose landmark is at a pixel."""
    across = whiteners[k, i, 0] * (pixels[0, 0] - seen[k, 0])
    return across + whiteners[k, i, 1] * (pixels[0, 1] - seen[k, 1])


@njit(cache=True, nogil=True, error_model='numpy')
def group_energies(points, lens, scale, columns, origins, result):  # type: ignore[no-untyped-def]
    """Energies (G, 2) of the groups at one pose, as they are called and exchanged."""
    pixels, projections, place = np.empty((1, 2)), np.empty((1, 2, 3)), np.empty(3)
    segments, offsets, seen, whiteners, groups = points
    result[:] = 0.0
    for k in range(len(groups)):
        for e in range(2):
            shown = point_residual(
                segments, offsets, k, e, lens, columns, origins, pixels, projections, place
            )
            for i in range(2):
                residual = whitened_error(whiteners, seen, k, i, pixels) if shown else BEHIND
                result[groups[k], e] += geman_mcclure(residual, scale, 1.0)[0]


@njit(cache=True, nogil=True, error_model='numpy')
def lifted_energies(lifted, columns, origins, room, result):  # type: ignore[no-untyped-def]
    """Minus the log densities of the mixture at one pose, as the sides are called and exchanged.

    Args:
        lifted: the mixture.
        columns, origins: frames of the pose.
        room: `LiftedRoom`, filled.
        result: (2,).
    """
    segments, offsets, ray = lifted.segments, lifted.offsets, lifted.ray
    behind, places, shares = room
    for i in range(3):
        places[0, i] = origins[0, i]
        for j in range(3):
            places[0, i] += columns[0, j, i] * lifted.middle[j]
    for k in range(len(segments)):
        behind[k] = 0.0
        for i in range(3):
            place = origins[segments[k], i]
            for j in range(3):
                place += columns[segments[k], j, i] * offsets[k, j]
            places[1 + k, i] = place
            behind[k] += (place - places[0, i]) * ray[i]
    for e in range(2):
        top = -np.inf
        for c in range(len(lifted.log_weights)):
            total = lifted.log_weights[c]
            for k in range(len(segments)):
                residual = lifted.precisions[e, c, k] * (behind[k] - lifted.depths[e, c, k])
                total -= geman_mcclure(residual, lifted.scale, 1.0)[0]
            shares[e, c] = total
            top = max(top, total)
        mass = 0.0
        for c in range(len(lifted.log_weights)):
            shares[e, c] = np.exp(shares[e, c] - top)
            mass += shares[e, c]
        shares[e] /= mass
        result[e] = -top - np.log(mass)


@njit(cache=True, nogil=True, error_model='numpy')
def add_lifted(  # type: ignore[no-untyped-def]
    lifted, tree, readings, room, axes, dof_origins, gradient, hessian
):
    """Adds the derivatives of the mixture at one pose.

    A joint moves against the middle of the hips, so that variables that move the hips count as if
    they turned about them and shifted nothing.

    Args:
        lifted, tree: the mixture, and the skeleton.
        readings: (2,) probabilities of the readings.
        room: of `lifted_energies`.
        axes, dof_origins: (d, 3) of the degrees of freedom.
        gradient, hessian: (d,), (d, d) results.
    """
    behind, places, shares = room
    own_axes, own_origins = axes.copy(), dof_origins.copy()
    for j in range(len(axes)):
        if tree.dof_segments[j] == 0:
            if tree.dof_is_rotation[j]:
                own_origins[j] = places[0]
            else:
                own_axes[j] = 0.0
    wrenches = np.zeros((len(tree.parents), 6))
    stiffnesses = np.zeros((len(tree.parents), 6, 6))
    ray = lifted.ray
    for k in range(len(lifted.segments)):
        pull, curvature = 0.0, 0.0
        for e in range(2):
            for c in range(len(lifted.log_weights)):
                precision = lifted.precisions[e, c, k]
                share = lifted.weight * readings[e] * shares[e, c]
                residual = precision * (behind[k] - lifted.depths[e, c, k])
                _, slope, bend = geman_mcclure(residual, lifted.scale, share)
                pull += precision * slope
                curvature += precision * precision * bend
        add_residual(
            wrenches,
            stiffnesses,
            lifted.segments[k],
            places[1 + k, 0],
            places[1 + k, 1],
            places[1 + k, 2],
            ray[0],
            ray[1],
            ray[2],
            pull,
            curvature,
        )
    assemble_pose(tree, own_axes, own_origins, wrenches, stiffnesses, gradient, hessian)


class LiftedRoom(NamedTuple):
    """Room for `lifted_energies` of one pose.

    Attributes:
        behind: (J,) how far the joints are behind the middle of the hips.
        places: (1 + J, 3) the middle of the hips and the joints.
        shares: (2, C) posterior probabilities of the components.
    """

    behind: Array
    places: Array
    shares: Array


@njit(cache=True, nogil=True)
def _lifted_room(lifted):  # type: ignore[no-untyped-def]
    joints = len(lifted.segments)
    return LiftedRoom(
        np.empty(joints), np.empty((1 + joints, 3)), np.empty((2, len(lifted.log_weights)))
    )


@njit(cache=True, nogil=True, error_model='numpy')
def weigh_exchanges(inputs, log_prior, columns, origins, room, result):  # type: ignore[no-untyped-def]
    """Log probabilities (E,) of exchanges at one pose; returns minus the log of their sum before.

    Args:
        inputs: of the keypoints.
        log_prior: (E,) of the exchanges.
        columns, origins: frames of the pose.
        room: `LiftedRoom`.
        result: (E,).
    """
    weights, exchanged, readings = inputs.weights, inputs.exchanged, inputs.lifted.readings
    energies, lifted = np.empty((exchanged.shape[1], 2)), np.zeros(2)
    group_energies(inputs.points, inputs.lens, inputs.scale, columns, origins, energies)
    if inputs.lifted.weight > 0.0:
        lifted_energies(inputs.lifted, columns, origins, room, lifted)
        lifted *= inputs.lifted.weight
    top = -np.inf
    for e in range(len(exchanged)):
        total = log_prior[e] - lifted[readings[e]]
        for g in range(len(energies)):
            total -= weights[g] * energies[g, exchanged[e, g]]
        result[e] = total
        top = max(top, total)
    mass = 0.0
    for e in range(len(exchanged)):
        mass += np.exp(result[e] - top)
    total = top + np.log(mass)
    for e in range(len(exchanged)):
        result[e] -= total
    return -total


@njit(cache=True, nogil=True)
def exchange_posteriors(inputs, log_priors, columns, origins, result):  # type: ignore[no-untyped-def]
    """Log probabilities (N, E) of exchanges at N poses, with a row of priors for each."""
    room = _lifted_room(inputs.lifted)
    for n in range(len(columns)):
        weigh_exchanges(inputs, log_priors[n], columns[n], origins[n], room, result[n])


@njit(cache=True, nogil=True, error_model='numpy')
def list_keypoints(  # type: ignore[no-untyped-def]
    inputs, columns, origins, errors, which, places, directions, pulls, curvatures
):
    """Lists the residuals of keypoints at one pose, in the exchange that is likeliest there.

    Args:
        inputs: with a row of priors.
        columns, origins: frames of the pose.
        errors: (P, 2) become the whitened errors of the keypoints; NaN behind the camera.
        which: (M, 2) becomes the keypoint of each residual, and 1 where it is exchanged.
        places, directions: (M, 3) become the landmark and the derivative of the residual by it.
        pulls, curvatures: (M,) become those of the energy by the residual.

    Returns:
        The number of residuals, two a landmark before the camera.
    """
    scale, weights, exchanged = inputs.scale, inputs.weights, inputs.exchanged
    posterior = np.empty(len(exchanged))
    pixels, projections, place = np.empty((1, 2)), np.empty((1, 2, 3)), np.empty(3)
    segments, offsets, seen, whiteners, groups = inputs.points
    room = _lifted_room(inputs.lifted)
    weigh_exchanges(inputs, inputs.log_priors[0], columns, origins, room, posterior)
    likeliest = exchanged[np.argmax(posterior)]
    m = 0
    for k in range(len(groups)):
        e = likeliest[groups[k]]
        if not point_residual(
            segments, offsets, k, e, inputs.lens, columns, origins, pixels, projections, place
        ):
            errors[k] = np.nan
            continue
        for i in range(2):
            w0, w1 = whiteners[k, i, 0], whiteners[k, i, 1]
            error = whitened_error(whiteners, seen, k, i, pixels)
            errors[k, i] = error
            shrink = 1.0 / (1.0 + error * error / (scale * scale))
            curvatures[m] = weights[groups[k]] * shrink * shrink
            pulls[m] = curvatures[m] * error
            which[m, 0], which[m, 1] = k, e
            for x in range(3):
                places[m, x] = place[x]
                directions[m, x] = w0 * projections[0, 0, x] + w1 * projections[0, 1, x]
            m += 1
    return m


@njit(cache=True, nogil=True)
def _list_room(count):  # type: ignore[no-untyped-def]
    """Room for the list of the residuals of so many keypoints."""
    return (
        np.empty((count, 2)),
        np.empty((2 * count, 2), np.intp),
        np.empty((2 * count, 3)),
        np.empty((2 * count, 3)),
        np.empty(2 * count),
        np.empty(2 * count),
    )


@njit(cache=True, nogil=True)
def keypoint_errors(inputs, columns, origins, errors):  # type: ignore[no-untyped-def]
    """Fills the errors (N, P, 2) of `list_keypoints` at the frames of N poses."""
    _, which, places, directions, pulls, curvatures = _list_room(errors.shape[1])
    for n in range(len(columns)):
        list_keypoints(
            inputs, columns[n], origins[n], errors[n], which, places, directions, pulls, curvatures
        )


@njit(cache=True, nogil=True)
def record_keypoints(inputs, joints, columns, origins, residuals):  # type: ignore[no-untyped-def]
    """Lists the residuals of keypoints at N poses as `registry.record_residuals` does.

    The first number of a residual is its joint of the skeleton instead of a segment.

    Args:
        inputs: as for `list_keypoints`.
        joints: (P, 2) of the skeleton that the keypoints show, as called and exchanged.
        columns, origins: (N, S, 3, 3), (N, S, 3) frames of the segments.
        residuals: (N, 1 + 2 P, RECORDED) result.
    """
    errors, which, places, directions, pulls, curvatures = _list_room(len(joints))
    for n in range(len(columns)):
        m = list_keypoints(
            inputs, columns[n], origins[n], errors, which, places, directions, pulls, curvatures
        )
        residuals[n, 0, 0] = m
        for i in range(m):
            row = residuals[n, 1 + i]
            row[0] = joints[which[i, 0], which[i, 1]]
            row[1:4], row[4:7] = places[i], directions[i]
            row[7], row[8] = pulls[i], curvatures[i]


@njit(cache=True, nogil=True, error_model='numpy')
def add_keypoints(  # type: ignore[no-untyped-def]
    inputs, log_prior, columns, origins, axes, dof_origins, wanted, gradient, hessian
):
    """The energy of one pose; adds gradient (d,) and Hessian (d, d).

    Args:
        inputs: of the keypoints.
        log_prior: (E,) of the exchanges.
        columns, origins: (S, 3, 3), (S, 3) frames of the segments.
        axes, dof_origins: (d, 3) of the degrees of freedom.
        wanted: whether derivatives are wanted.
        gradient, hessian: added to.
    """
    lifted, tree, lens = inputs.lifted, inputs.tree, inputs.lens
    scale, weights, exchanged = inputs.scale, inputs.weights, inputs.exchanged
    groups = exchanged.shape[1]
    posterior, room = np.empty(len(exchanged)), _lifted_room(lifted)
    value = weigh_exchanges(inputs, log_prior, columns, origins, room, posterior)
    if not wanted:
        return value
    shares = np.zeros((groups, 2))
    for e in range(len(exchanged)):
        for g in range(groups):
            shares[g, exchanged[e, g]] += np.exp(posterior[e])
    wrenches = np.zeros((len(tree.parents), 6))
    stiffnesses = np.zeros((len(tree.parents), 6, 6))
    pixels, projections, place = np.empty((1, 2)), np.empty((1, 2, 3)), np.empty(3)
    segments, offsets, seen, whiteners, point_groups = inputs.points
    for k in range(len(point_groups)):
        for e in range(2):
            share = weights[point_groups[k]] * shares[point_groups[k], e]
            if share < 1e-6 or not point_residual(
                segments, offsets, k, e, lens, columns, origins, pixels, projections, place
            ):
                continue
            for i in range(2):
                w0, w1 = whiteners[k, i, 0], whiteners[k, i, 1]
                residual = whitened_error(whiteners, seen, k, i, pixels)
                _, pull, curvature = geman_mcclure(residual, scale, share)
                add_residual(
                    wrenches,
                    stiffnesses,
                    segments[k, e],
                    place[0],
                    place[1],
                    place[2],
                    w0 * projections[0, 0, 0] + w1 * projections[0, 1, 0],
                    w0 * projections[0, 0, 1] + w1 * projections[0, 1, 1],
                    w0 * projections[0, 0, 2] + w1 * projections[0, 1, 2],
                    pull,
                    curvature,
                )
    assemble_pose(tree, axes, dof_origins, wrenches, stiffnesses, gradient, hessian)
    if lifted.weight > 0.0:
        readings = np.zeros(2)
        for e in range(len(exchanged)):
            readings[lifted.readings[e]] += np.exp(posterior[e])
        add_lifted(lifted, tree, readings, room, axes, dof_origins, gradient, hessian)
    return value
