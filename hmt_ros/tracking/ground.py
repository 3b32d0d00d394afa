"""What is known of gravity and of the floor, and the present estimate of both.

Frame: camera optical frame of REP 103, m. The floor is the plane n.x + d = 0 with n = up, the unit
vector against gravity, and d the height of the camera above the floor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from hmt_ros.inference.arrays import Array


def upright() -> Array:
    """Up (3,) of a camera that looks to the horizon."""
    return np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True, eq=False)
class KnownGround:
    """What is known beforehand.

    Attributes:
        up: (3,) against gravity, camera frame; of unit length once made. None: unknown.
        camera_height: of the camera above the floor, m. None: unknown.

    Raises:
        ValueError: no direction, or a height that is not positive.
    """

    up: Array | None = None
    camera_height: float | None = None

    def __post_init__(self) -> None:
        if self.up is not None:
            v = np.asarray(self.up, dtype=np.float64)
            length = float(np.linalg.norm(v))
            if v.shape != (3,) or not 0 < length < math.inf:
                raise ValueError(f'up must be three finite numbers, not all zero; saw {v.tolist()}')
            object.__setattr__(self, 'up', v / length)
        height = self.camera_height
        if height is not None and not 0 < height < math.inf:
            raise ValueError(f'camera_height must be positive, saw {height}')


@dataclass(frozen=True, eq=False)
class Ground:
    """The present estimate.

    Attributes:
        up: (3,) unit vector against gravity, camera frame.
        up_sigma: standard deviation of its direction, rad.
        height: of the camera above the floor, m; None: unknown.
        height_sigma: standard deviation of the height, m.
    """

    up: Array = field(default_factory=upright)
    up_sigma: float = math.pi
    height: float | None = None
    height_sigma: float = math.inf

    @property
    def plane(self) -> Array | None:
        """The floor (4,): n, d with n.x + d = 0; None: unknown."""
        return None if self.height is None else np.array([*self.up, self.height])
