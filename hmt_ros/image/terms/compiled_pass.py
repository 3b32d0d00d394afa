"""All image terms of the likelihood for a range of poses, compiled; no Python between pixels."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface import (
    FleshTable,
    Lens,
    empty_contour,
    mark_visibility,
    trace_contour,
)
from hmt_ros.image.terms.accumulation import Tree, assemble_pose
from hmt_ros.image.terms.edges import add_edges
from hmt_ros.image.terms.silhouette import add_containment, add_coverage
from hmt_ros.image.terms.texture_terms import add_intensity, add_motion

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Columns of the table of energies.
CONTAINMENT, COVERAGE, EDGES, INTENSITY, MOTION = range(5)
TERM_COUNT = 5


class Term(NamedTuple):
    """Settings of a term as the compiled code reads them; weight 0: off."""

    weight: float
    sigma: float
    scale: float


class Terms(NamedTuple):
    """All terms."""

    containment: Term
    coverage: Term
    edges: Term
    intensity: Term
    motion: Term


class Evidence(NamedTuple):
    """What the compiled code reads of an image; empty maps belong to terms with weight 0.

    Attributes:
        distance, edges, intensity, flow: maps.
        outline_pixels, outline_normals: (M, 2).
    """

    distance: ImageMap
    edges: ImageMap
    intensity: ImageMap
    flow: ImageMap
    outline_pixels: Array
    outline_normals: Array


class Model(NamedTuple):
    """What the compiled code reads of the body and the camera.

    Attributes:
        tree, flesh, lens: skeleton, parts and rings, camera.
        traced: (B,) parts whose contour is compared with the image.
        occluders: (B,) parts that can hide others.
        textured: (S,) segments whose texture is compared.
        contour_points: number of contour points that the weights are for; 0: those there are.
    """

    tree: Tree
    flesh: FleshTable
    lens: Lens
    traced: Mask
    occluders: Mask
    textured: Mask
    contour_points: int


class Placement(NamedTuple):
    """Frames of N poses: columns (N, S, 3, 3), origins (N, S, 3); axes, dof origins (N, d, 3)."""

    columns: Array
    origins: Array
    axes: Array
    dof_origins: Array


@njit(cache=True, nogil=True)
def add_energies(  # type: ignore[no-untyped-def]
    first, last, model, terms, evidence, textures, which, placement, explained,
    energies, costs, gradients, hessians,
):  # fmt: skip
    """Energies, gradients and Hessians of the poses first to last - 1.

    Args:
        first, last: range of poses.
        model, terms, evidence, placement: what is compared with what.
        textures, which: (N,) index of the texture of each pose; negative: none.
        explained: (X, M) what samples of the outline cost at most; a row a pose, or one row for
            all.
        energies: (N, TERM_COUNT) result.
        costs: (N, M) result: what each sample of the outline costs.
        gradients, hessians: (N, d), (N, d, d), added to; hessians of no pose: no derivatives
            wanted.
    """
    segments = len(model.tree.parents)
    wrenches, stiffnesses = np.empty((segments, 6)), np.empty((segments, 6, 6))
    contour = empty_contour(len(model.flesh.ring_parts))
    shape = terms.containment.weight > 0 or terms.coverage.weight > 0 or terms.edges.weight > 0
    points = model.contour_points
    if points == 0:
        points = len(contour.parts)
    samples = len(evidence.outline_pixels)
    for n in range(first, last):
        wrenches[:] = 0.0
        stiffnesses[:] = 0.0
        columns, origins = placement.columns[n], placement.origins[n]
        if shape:
            trace_contour(model.flesh, model.traced, model.lens, columns, origins, contour)
            mark_visibility(
                model.flesh, model.occluders, columns, origins, contour.parts, contour.points,
                contour.valid, contour.covered, contour.hidden,
            )  # fmt: skip
        owner = model.flesh.part_segments
        if terms.containment.weight > 0:
            energies[n, CONTAINMENT] = add_containment(
                evidence.distance, contour, owner, terms.containment,
                terms.containment.weight / points, wrenches, stiffnesses,
            )  # fmt: skip
        if terms.coverage.weight > 0 and samples > 0:
            row = n if len(explained) > 1 else 0
            energies[n, COVERAGE] = add_coverage(
                evidence.outline_pixels, evidence.outline_normals, contour, owner, terms.coverage,
                terms.coverage.weight / samples, explained[row], costs[n], wrenches, stiffnesses,
            )  # fmt: skip
        if terms.edges.weight > 0:
            energies[n, EDGES] = add_edges(
                evidence.edges, contour, owner, terms.edges,
                model.contour_points * 6 // 10, wrenches, stiffnesses,
            )  # fmt: skip
        if which[n] >= 0 and terms.intensity.weight > 0:
            energies[n, INTENSITY] = add_intensity(
                evidence.intensity, textures, which[n], model.textured, model.lens, columns,
                origins, terms.intensity, wrenches, stiffnesses,
            )  # fmt: skip
        if which[n] >= 0 and terms.motion.weight > 0:
            energies[n, MOTION] = add_motion(
                evidence.flow, textures, which[n], model.textured, model.lens, columns, origins,
                terms.motion, wrenches, stiffnesses,
            )  # fmt: skip
        if len(hessians) > 0:
            assemble_pose(
                model.tree, placement.axes[n], placement.dof_origins[n], wrenches, stiffnesses,
                gradients[n], hessians[n],
            )  # fmt: skip
