"""Energy of poses against the optical flow from one image to the next (KJS 2).

    E(x) = w / Q sum_q rho(|u_q(x) - p_q - f(p_q)| / (sigma + 0.15 |f(p_q)|))

Q points of the surface were seen at pixels p_q of the previous image; the pose x moves them to
u_q(x), and f is the flow (`core/flow.h`). The term improves predictions of modes. Its values can
not be compared between modes, because each mode has its own points.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from hmt_ros.image.sampling import ImageMap
from hmt_ros.image.surface_points import SurfacePoints
from hmt_ros.image.terms.image_term import ImageWindow

# Minimum side of an image for its flow to be computed, px; smaller images have flow 0.
MIN_IMAGE_SIDE = 32


def optical_flow(window: ImageWindow) -> ImageMap | None:
    """Dense flow, two channels, px, from the previous image [Kroeger et al., ECCV 2016].

    NaN on pixels of other people; None if there is no previous image.
    """
    if window.last_image is None:
        return None
    grey = [cv2.cvtColor(x, cv2.COLOR_BGR2GRAY) for x in (window.last_image, window.image)]
    if min(grey[0].shape) < MIN_IMAGE_SIDE:
        return window.as_map(np.zeros((2, *grey[0].shape), np.float32))
    # OpenCV accepts None as initial flow, but the type stubs do not.
    method: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    with without_ipp():
        flow = method.calc(grey[0], grey[1], None)
    channels = np.empty((2, *grey[0].shape), np.float32)
    cv2.split(flow, list(channels))
    if window.others is not None:
        channels[:, window.others > 0] = np.nan
    return window.as_map(channels)


@contextmanager
def without_ipp() -> Iterator[None]:
    """Disable Intel's IPP in OpenCV in this thread: IPP's resizing depends on the processor."""
    before = cv2.ipp.useIPP()
    cv2.ipp.setUseIPP(False)
    try:
        yield
    finally:
        cv2.ipp.setUseIPP(before)


@dataclass(frozen=True, eq=False)
class FlowTerm:
    """The energy of poses against the optical flow.

    Attributes:
        points: surface points of K poses in the previous image, one pose per problem.
        flow: flow from the previous image to this image.
        weight: w, number of independent measurements.
    """

    points: SurfacePoints
    flow: ImageMap
    weight: float

    @property
    def compiled(self) -> tuple[SurfacePoints, ImageMap, float]:
        """The term as input of the compiled core."""
        return self.points, self.flow, self.weight
