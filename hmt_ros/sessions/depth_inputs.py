"""Depth images that wait for their image.

A depth image belongs to the image of exactly its stamp, and has its size. One that can not be used
counts as none: the image goes on without it.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.terms.depth import FURTHEST, NEAREST, usable_depths
from hmt_ros.inference.arrays import Image
from hmt_ros.sessions.camera_session import StampedInputs, WaitingImage
from hmt_ros.sessions.handled import Fault, HandlingLog
from msg_tools.messages.depth_images import decode_depth
from msg_tools.messages.images import ImageError

DEPTH = 'depth'
# Depth images that are remembered; they are large.
_REMEMBERED = 64


class DepthInputs:
    """The depth images that have come.

    Args:
        log: takes faults.

    Attributes:
        images: (H, W) m by stamp, 0 where nothing was measured.
    """

    def __init__(self, log: HandlingLog) -> None:
        self._log = log
        self.images: StampedInputs[NDArray[np.float32]] = StampedInputs(_REMEMBERED)

    def put(self, message: Any, stamp_ns: int) -> None:
        """Takes a sensor_msgs/Image, 16UC1 or 32FC1; one that can not be used counts as none."""
        depth = None
        try:
            depth = usable_depths(decode_depth(message))
        except ImageError as error:
            self._log.fault(Fault.DEPTH, str(error))
        if depth is not None and not depth.any():
            self._log.fault(
                Fault.DEPTH,
                f'depth of {stamp_ns} ns lies nowhere between {NEAREST:g} and {FURTHEST:g} m: '
                'wanted 16UC1 in mm or 32FC1 in m',
            )
            depth = None
        self.images.put(stamp_ns, depth)

    def added_to(self, waiting: WaitingImage, dropped: Container[int] = ()) -> WaitingImage:
        """An image with its depths, where there are some that fit.

        Args:
            waiting: the image.
            dropped: stamps of images that were dropped, whose depth is not missed.
        """
        return waiting._replace(depth=self._take(waiting.image, waiting.stamp_ns, dropped))

    def _take(
        self, image: Image, stamp_ns: int, dropped: Container[int]
    ) -> NDArray[np.float32] | None:
        for each in self.images.before(stamp_ns):
            if each in dropped:
                continue
            self._log.note(
                Fault.LONE_DEPTH,
                f'depth of {each} ns belongs to no image, or comes too late: wanted the stamp of '
                'an image',
            )
        known = stamp_ns in self.images
        depth = self.images.take(stamp_ns)
        if not known:
            self._log.note(Fault.NO_DEPTH, f'no depth has come for the image of {stamp_ns} ns')
        if depth is None or depth.shape == image.shape[:2]:
            return depth
        (height, width), (rows, columns) = depth.shape, image.shape[:2]
        self._log.fault(
            Fault.DEPTH,
            f'depth of {stamp_ns} ns has {width}x{height} pixels, wanted the {columns}x{rows} of '
            'its image: use depth that is registered to the colour camera',
        )
        return None


def depth_elsewhere(stamp_ns: int) -> str:
    """Warns of depth images that do not show the person."""
    return (
        f'depth of {stamp_ns} ns does not show the person where the image does: depth images are '
        'not used until they do; wanted depth of the same time, registered to the colour camera'
    )
