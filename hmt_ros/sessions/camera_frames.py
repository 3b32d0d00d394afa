"""Gravity, height and pose of the camera, from transforms to other frames.

A frame with z up (`gravity_frame`) gives the direction of gravity and, if z = 0 is the floor, the
height of the camera. A stationary frame (`fixed_frame`) gives the motion of the camera. Both may be
the same frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import length
from hmt_ros.sessions.transform_buffer import Transform, TransformBuffer, TransformError
from hmt_ros.tracking.ground import KnownGround
from hmt_ros.tracking.settings import MAX_EXTRAPOLATION_TIME

# Minimum length of a vector that has a direction.
_MIN_VECTOR_LENGTH = 1e-6


# Standard deviation of a direction from transforms (inertial sensor and its mounting), rad.
UP_SIGMA = 0.01


class CameraFrames:
    """Gravity and pose of the camera, relative to frames that are connected by transforms.

    Args:
        gravity_frame: name of a frame with z up; '': no such frame.
        fixed_frame: name of a stationary frame; '': no such frame.
        floor: whether z = 0 of `gravity_frame` is the floor.

    Attributes:
        newest: whether transforms gave the direction of gravity at the last image.
        heard: whether any transform was received.
        pose: pose of the camera in `fixed_frame` at the last image; None if unknown.
    """

    def __init__(
        self, gravity_frame: str = '', fixed_frame: str = '', *, floor: bool = False
    ) -> None:
        self.gravity_frame = gravity_frame
        self.fixed_frame = fixed_frame
        # Newest direction against gravity, and height of the camera above z = 0 of `gravity_frame`,
        # m; None: unknown.
        self._gravity: tuple[Array, float] | None = None
        self.newest = False
        self.pose: Transform | None = None
        self._floor = floor
        self.heard = False
        self._transforms = TransformBuffer()

    @property
    def wanted(self) -> bool:
        """Whether a frame is named, so that transforms are needed."""
        return bool(self.gravity_frame or self.fixed_frame)

    def take(self, message: Any, *, static: bool) -> list[str]:
        """Stores a tf2_msgs/TFMessage; see `TransformBuffer.put`."""
        self.heard = True
        return self._transforms.put(message, static=static)

    def forget_after(self, stamp_ns: int) -> None:
        """Forgets gravity, the pose, and the transforms after a stamp."""
        self._transforms.forget_after(stamp_ns)
        self._gravity, self.newest, self.pose = None, False, None

    def is_settled(self, camera_frame: str, stamp_ns: int, timeout_ns: float) -> bool:
        """Whether an image need not wait: its transforms or later transforms have arrived."""
        if self._transforms.has_later(stamp_ns, timeout_ns):
            return True
        try:
            for name in filter(None, (self.gravity_frame, self.fixed_frame)):
                self._transforms.lookup(camera_frame, name, stamp_ns)
        except TransformError:
            return False
        return True

    def update(self, camera_frame: str, stamp_ns: int) -> list[tuple[str, str]]:
        """Looks up gravity and the pose of the camera at the time of an image.

        Returns:
            Kind and text of each fault.
        """
        gravity = self._find_gravity(camera_frame, stamp_ns) if self.gravity_frame else []
        pose = self._find_pose(camera_frame, stamp_ns) if self.fixed_frame else []
        return gravity + pose

    def known_ground(self, otherwise: KnownGround) -> KnownGround:
        """Return gravity and height from the newest transforms, or `otherwise` without them."""
        if self._gravity is None:
            return otherwise
        up, height = self._gravity
        known = height if self._floor and height > 0 else otherwise.camera_height
        return KnownGround(up, known, UP_SIGMA)

    def _find_gravity(self, camera_frame: str, stamp_ns: int) -> list[tuple[str, str]]:
        name, self.newest = self.gravity_frame, False
        try:
            found = self._transforms.lookup(camera_frame, name, stamp_ns)
        except TransformError as error:
            text = (
                f'no transform from gravity_frame {name!r} to {camera_frame!r} at the image of '
                f'{stamp_ns} ns: {error}; the track continues with the last known gravity'
            )
            return [('no transform', text)]
        up = found.rotation[:, 2]
        height = float(found.inverse().translation[2])
        self._gravity, self.newest = (up / length(up), height), True
        if height > 0 or not self._floor:
            return []
        text = (
            f'the camera lies {-height:.2f} m below z = 0 of gravity_frame {name!r}, which '
            'can not be the floor'
        )
        return [('height of the camera', text)]

    def _find_pose(self, camera_frame: str, stamp_ns: int) -> list[tuple[str, str]]:
        name = self.fixed_frame
        try:
            self.pose = self._transforms.lookup(name, camera_frame, stamp_ns)
        except TransformError as error:
            self.pose = None
            text = (
                f'no transform from {camera_frame!r} to fixed_frame {name!r} at the image of '
                f'{stamp_ns} ns: {error}; the motion of the camera is assumed to continue for '
                f'{MAX_EXTRAPOLATION_TIME} s'
            )
            return [('no pose of the camera', text)]
        return []


def unit_vector(vector: Sequence[float], name: str) -> Array:
    """Scale a vector (3,) to unit length.

    Raises:
        ValueError: the vector is not three finite numbers, or is zero.
    """
    v = np.asarray(vector, dtype=np.float64)
    size = length(v) if v.shape == (3,) else math.nan
    if not _MIN_VECTOR_LENGTH < size < math.inf:
        raise ValueError(f'{name} must be three finite numbers, not all zero, saw {v.tolist()}')
    return v / size
