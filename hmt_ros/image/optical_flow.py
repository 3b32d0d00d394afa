"""Energy of poses against the optical flow from one image to the next (KJS 2).

    E(x) = w / Q sum_q rho(|u_q(x) - p_q - f(p_q)| / (sigma + 0.15 |f(p_q)|))

Q points of the surface were seen at pixels p_q of the image before; the pose x moves them to
u_q(x), and f is the flow. Predictions follow it; it is no evidence about which mode is right, since
each compares points of its own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit

from hmt_ros.image.sampling import ImageMap, sample
from hmt_ros.image.surface import project
from hmt_ros.image.surface_points import SurfacePoints
from hmt_ros.image.terms.image_term import ImageWindow
from hmt_ros.image.terms.residuals import FEWEST, add_residual, assemble_pose, geman_mcclure

# Standard deviation of the flow, px, and its further error, as a share of the displacement.
SIGMA, SHARE = 1.5, 0.15
# Width of the Geman-McClure kernel, in standard deviations.
SCALE = 2.0
# Smaller images, px, have a flow of 0.
SMALLEST = 32


def optical_flow(window: ImageWindow) -> ImageMap | None:
    """Dense flow from the last image to this one, two channels, px [Kroeger et al., ECCV 2016].

    NaN on pixels of somebody else; None: there is no last image.
    """
    if window.last_image is None:
        return None
    grey = [cv2.cvtColor(x, cv2.COLOR_BGR2GRAY) for x in (window.last_image, window.image)]
    if min(grey[0].shape) < SMALLEST:
        return window.as_map(np.zeros((2, *grey[0].shape), np.float32))
    # The stubs do not know that there may be no flow to start from.
    method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    flow = method.calc(grey[0], grey[1], None)
    channels = np.ascontiguousarray(flow.transpose(2, 0, 1))
    if window.others is not None:
        channels[:, window.others > 0] = np.nan
    return window.as_map(channels)


class FlowTerm(NamedTuple):
    """The energy of poses against the flow, as compiled code reads it.

    Attributes:
        points: of K poses in the image before, one for each problem.
        flow: from that image to this one.
        weight: w, number of independent measurements.
    """

    points: SurfacePoints
    flow: ImageMap
    weight: float

    @property
    def compiled(self) -> FlowTerm:
        """The term as compiled code reads it."""
        return self


@njit(cache=True, nogil=True)
def add_flow(  # type: ignore[no-untyped-def]
    term, tree, lens, row, columns, origins, axes, dof_origins, wanted, value, gradient, hessian
):
    """Adds energy (1,), gradient (d,) and Hessian (d, d) of a pose of one problem.

    Args:
        term: `FlowTerm`.
        tree, lens: skeleton and camera.
        row: of the problem.
        columns, origins: (S, 3, 3), (S, 3) frames of the segments.
        axes, dof_origins: (d, 3) of the degrees of freedom.
        wanted: whether derivatives are wanted.
        value, gradient, hessian: added to.
    """
    points, flow = term.points, term.flow
    segments = len(tree.parents)
    wrenches, stiffnesses = np.zeros((segments, 6)), np.zeros((segments, 6, 6))
    pixel, projection = np.empty((1, 2)), np.empty((1, 2, 3))
    values, left, top = flow.values, flow.left, flow.top
    carriers, local, pixels = points.segments[row], points.local[row], points.pixels[row]
    count = points.counts[row]
    each = term.weight / max(count, FEWEST)
    for q in range(count):
        s = carriers[q]
        x, y, z = local[q, 0], local[q, 1], local[q, 2]
        axis, origin = columns[s], origins[s]
        p0 = origin[0] + axis[0, 0] * x + axis[1, 0] * y + axis[2, 0] * z
        p1 = origin[1] + axis[0, 1] * x + axis[1, 1] * y + axis[2, 1] * z
        p2 = origin[2] + axis[0, 2] * x + axis[1, 2] * y + axis[2, 2] * z
        if not project(lens, p0, p1, p2, 0, pixel, projection):
            continue
        u, v = pixels[q, 0], pixels[q, 1]
        fu, _, _ = sample(values, left, top, 0, u, v)
        fv, _, _ = sample(values, left, top, 1, u, v)
        if np.isnan(fu):
            # Somebody else hides it: it has the usual cost, wherever it is.
            value[0] += geman_mcclure(1.0, SCALE, each)[0]
            continue
        inverse = 1.0 / (SIGMA + SHARE * np.sqrt(fu * fu + fv * fv))
        e0, e1 = (pixel[0, 0] - u - fu) * inverse, (pixel[0, 1] - v - fv) * inverse
        rho, _, curvature = geman_mcclure(np.sqrt(e0 * e0 + e1 * e1), SCALE, each)
        value[0] += rho
        for a in range(2):
            error = e0 if a == 0 else e1
            add_residual(
                wrenches,
                stiffnesses,
                s,
                p0,
                p1,
                p2,
                projection[0, a, 0] * inverse,
                projection[0, a, 1] * inverse,
                projection[0, a, 2] * inverse,
                curvature * error,
                curvature,
            )
    if wanted:
        assemble_pose(tree, axes, dof_origins, wrenches, stiffnesses, gradient, hessian)
