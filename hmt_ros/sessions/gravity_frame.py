"""Gravity and the height of the camera, as a frame with z up tells them through transforms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.handled import Fault
from hmt_ros.sessions.transform_buffer import TransformBuffer, TransformError
from hmt_ros.tracking.ground import KnownGround

# A vector that is shorter has no direction.
_SHORTEST = 1e-6


class SeenGravity(NamedTuple):
    """What the transforms tell about a camera at a time.

    Attributes:
        up: (3,) unit vector against gravity, camera frame.
        height: of the camera above z = 0 of the frame, m.
    """

    up: Array
    height: float


class GravityFrame:
    """A frame with z up, and the transforms that lead to it.

    Args:
        name: of the frame.
        floor: whether its plane z = 0 is the floor.

    Attributes:
        seen: what was seen last; None: nothing yet.
    """

    def __init__(self, name: str, *, floor: bool) -> None:
        self.name = name
        self.seen: SeenGravity | None = None
        self._floor = floor
        self._transforms = TransformBuffer()

    def take(self, message: Any, *, static: bool) -> list[str]:
        """Takes a tf2_msgs/TFMessage; see `TransformBuffer.put`."""
        return self._transforms.put(message, static=static)

    def forget_after(self, stamp_ns: int) -> None:
        """See `TransformBuffer.forget_after`; what was seen of gravity is forgotten, too."""
        self._transforms.forget_after(stamp_ns)
        self.seen = None

    def is_settled(self, camera_frame: str, stamp_ns: int, timeout_ns: float) -> bool:
        """Whether an image need not wait: its transforms are there, or those of a later time."""
        newest = self._transforms.newest_ns
        if newest is not None and newest - stamp_ns > timeout_ns:
            return True
        try:
            self._transforms.lookup(camera_frame, self.name, stamp_ns)
        except TransformError:
            return False
        return True

    def look(self, camera_frame: str, stamp_ns: int) -> list[tuple[Fault, str]]:
        """Looks gravity up at the time of an image.

        Returns:
            What is wrong; where there is no transform, what was looked for and what there is.
        """
        try:
            found = self._transforms.lookup(camera_frame, self.name, stamp_ns)
        except TransformError as error:
            text = (
                f'no transform from gravity_frame {self.name!r} to {camera_frame!r} at the image '
                f'of {stamp_ns} ns: {error}; the track goes on with what was known of gravity'
            )
            return [(Fault.NO_TRANSFORM, text)]
        up = found.rotation[:, 2]
        height = float(found.inverse().translation[2])
        self.seen = SeenGravity(up / np.linalg.norm(up), height)
        if height > 0 or not self._floor:
            return []
        text = (
            f'the camera lies {-height:.2f} m below z = 0 of gravity_frame {self.name!r}, which '
            'can not be the floor'
        )
        return [(Fault.CAMERA_HEIGHT, text)]

    def known_ground(self, otherwise: KnownGround) -> KnownGround:
        """What was seen last, in place of what is known otherwise."""
        if self.seen is None:
            return otherwise
        height = otherwise.camera_height
        if self._floor and self.seen.height > 0:
            height = self.seen.height
        return KnownGround(self.seen.up, height)


def unit_vector(vector: Sequence[float], name: str) -> Array:
    """A vector (3,) at unit length.

    Raises:
        ValueError: not three finite numbers, or a vector without length.
    """
    v = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(v)) if v.shape == (3,) else math.nan
    if not _SHORTEST < length < math.inf:
        raise ValueError(f'{name} must be three finite numbers, not all zero, saw {v.tolist()}')
    result: Array = v / length
    return result
