"""Pose of the camera of a rendered image: above a floor, in front of the person."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.inference.arrays import Array


@dataclass(frozen=True)
class Viewpoint:
    """A camera above a floor.

    Attributes:
        distance: horizontal distance of the camera from the origin of the world, m.
        height: height of the camera above the floor, m.
        pitch: angle by which the camera looks down, rad.

    Raises:
        ValueError: a value is outside its range.
    """

    distance: float = 5.6
    height: float = 1.2
    pitch: float = 0.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ('distance', 0.1, 1000.0),
            ('height', 0.01, 100.0),
            ('pitch', -1.4, 1.4),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f'{name} of the camera must lie in [{low}, {high}], saw {value}')

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3) from the world to the camera optical frame."""
        c, s = np.cos(self.pitch), np.sin(self.pitch)
        return np.array([[-1.0, 0.0, 0.0], [0.0, s, -c], [0.0, -c, -s]])

    @property
    def translation(self) -> Array:
        """The world's origin (3,) in the camera optical frame, m."""
        return np.asarray(self.rotation @ np.array([0.0, -self.distance, -self.height]))

    def to_camera(self, points: ArrayLike) -> Array:
        """Points (..., 3) of the world in the camera optical frame, m."""
        return np.asarray(points, dtype=np.float64) @ self.rotation.T + self.translation

    def to_world(self, points: ArrayLike) -> Array:
        """Points (..., 3) of the camera optical frame in the world, m."""
        return (np.asarray(points, dtype=np.float64) - self.translation) @ self.rotation
