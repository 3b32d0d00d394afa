"""All terms of the image likelihood, and the compiled pass that runs them pose by pose.

    E_image(x) = sum_t E_t(x)        over the terms t of the registry

A new term is a file beside this one and a line in `TERMS`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from hmt_ros.image.surface import (
    FleshTable,
    Lens,
    empty_contour,
    mark_visibility,
    trace_contour,
)
from hmt_ros.image.terms.depth import DEPTH
from hmt_ros.image.terms.edges import EDGES
from hmt_ros.image.terms.image_term import ImageTerm, PoseView
from hmt_ros.image.terms.residuals import Tree
from hmt_ros.image.terms.silhouette import COVERAGE
from hmt_ros.inference.arrays import Mask

TERMS: tuple[ImageTerm, ...] = (COVERAGE, EDGES, DEPTH)


class Model(NamedTuple):
    """Body and camera as compiled code reads them.

    Attributes:
        tree, flesh, lens: skeleton, parts and rings, camera.
        traced: (B,) parts whose contour is compared with the image.
        occluders: (B,) parts that can hide others.
        contour_points: number of contour points that the weights are for; 0: those there are.
    """

    tree: Tree
    flesh: FleshTable
    lens: Lens
    traced: Mask
    occluders: Mask
    contour_points: int


def _one_after_the_other(terms: tuple[ImageTerm, ...]) -> Any:
    """One compiled function that runs the kernels of all terms on a pose.

    It calls the first kernel with the first inputs and hands the rest on to the function of the
    other terms: the compiler unrolls the list, and every term keeps its own type of inputs.
    """
    if not terms:

        @njit(nogil=True, inline='always')
        def nothing(view, inputs, column, energies, wrenches, stiffnesses):  # type: ignore[no-untyped-def]
            return

        return nothing
    kernel = terms[0].kernel
    others = _one_after_the_other(terms[1:])

    @njit(nogil=True, inline='always')
    def first_and_others(view, inputs, column, energies, wrenches, stiffnesses):  # type: ignore[no-untyped-def]
        own = inputs[0]
        if own[0].weight > 0.0:
            energies[column] = kernel(view, own, wrenches, stiffnesses)
        others(view, inputs[1:], column + 1, energies, wrenches, stiffnesses)

    return first_and_others


run_terms = _one_after_the_other(TERMS)


@njit(cache=True, nogil=True)
def new_view(model):  # type: ignore[no-untyped-def]
    """Room for one pose after the other as kernels see them.

    It is made once: to pass so many arrays on costs as much as a kernel.
    """
    segments = len(model.tree.parents)
    return PoseView(
        np.zeros(1, np.int64),
        empty_contour(len(model.flesh.ring_parts)),
        model.contour_points,
        model.flesh.part_segments,
        model.lens,
        np.empty((segments, 3, 3)),
        np.empty((segments, 3)),
        model.flesh,
        model.traced,
        model.occluders,
    )


@njit(cache=True, nogil=True, inline='always')
def look(view, number, shape):  # type: ignore[no-untyped-def]
    """Takes in the pose, of this number, whose frames are in a view; its contour if shape is."""
    view.number[0] = number
    if shape:
        contour = view.contour
        trace_contour(view.flesh, view.traced, view.lens, view.columns, view.origins, contour)
        mark_visibility(
            view.flesh,
            view.occluders,
            view.columns,
            view.origins,
            contour.parts,
            contour.points,
            contour.valid,
            contour.covered,
            contour.hidden,
        )


@njit(cache=True, nogil=True)
def record_residuals(model, inputs, columns, origins, residuals):  # type: ignore[no-untyped-def]
    """Lists the residuals of N poses, instead of summing them.

    Args:
        model: body and camera.
        inputs: of the kernels, one entry a term, in the order of `TERMS`; the contour is traced.
        columns, origins: (N, S, 3, 3), (N, S, 3) frames of the segments.
        residuals: (N, M, RECORDED) result, see `residuals.add_residual`; entries (n, 0, 0) must be
            0 and become the number of residuals of pose n.
    """
    view, nothing, energies = new_view(model), np.empty((0, 6, 6)), np.empty(len(inputs))
    for n in range(len(columns)):
        view.columns[:], view.origins[:] = columns[n], origins[n]
        look(view, n, True)
        run_terms(view, inputs, 0, energies, residuals[n], nothing)
