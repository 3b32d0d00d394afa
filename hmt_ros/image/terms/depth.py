"""Depth: visible points of the model's surface lie on the surface measured by a depth image.

    E(x) = w / V sum_i rho((D(u_i(x)) - z_i(x)) / sigma_i)
    sigma_i^2 = sigma^2 + (growth D^2)^2 + (noise_i / cos a_i)^2

over the V visible points i of the flesh: on every ring, one point on either side of the place that
faces the camera. D is the depth image, registered to the colour image, and z the depth of the
point, both along the axis of the camera, m. The error of a triangulating sensor grows with the
square of the distance [Khoshelham and Elberink, Sensors 2012]. The error of the flesh, `noise`, is
along the normal of the surface, and a is the angle between the normal and the ray. For the
gradient, points are fixed to the skin, and standard deviations are treated as constant.

A point without a measurement has the cost of an error of one standard deviation, at every pose. A
surface in front of a point, or far behind it, costs at most the maximum of the kernel.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.terms.image_term import (
    ImageTerm,
    ImageWindow,
    TermSettings,
    Weighting,
)

# Range of depths that sensors measure, m; other depths are no evidence.
MIN_DEPTH, MAX_DEPTH = 0.2, 20.0


class DepthInputs(NamedTuple):
    """Inputs of `core/terms/depth.h`: depths, m, 0 where nothing was measured."""

    term: Weighting
    depths: ImageMap


NO_DEPTHS = ImageMap(np.zeros((1, 2, 2), np.float32))


def usable_depths(depth: NDArray[np.floating]) -> NDArray[np.float32]:
    """A depth image (H, W), m, with 0 for missing depths and depths out of range."""
    with np.errstate(invalid='ignore'):
        good = (depth >= MIN_DEPTH) & (depth <= MAX_DEPTH)
    result: NDArray[np.float32] = np.where(good, depth, 0.0).astype(np.float32)
    return result


def depth_map(window: ImageWindow) -> ImageMap | None:
    """The depths of a window; None if no pixel was measured."""
    if window.depth is None:
        return None
    depths = usable_depths(window.depth)
    return window.as_map(depths[None]) if depths.any() else None


def _inputs(term: Weighting, evidence: Any) -> DepthInputs:
    return DepthInputs(term, evidence or NO_DEPTHS)


DEPTH = ImageTerm(
    'depth',
    'Depth of visible points of the surface from the depth image.',
    TermSettings(30.0, 0.01, 4.0, growth=0.002),
    depth_map,
    _inputs,
)
