"""The ground: which way is up, and how far the floor lies below the camera.

    h(p) = n . p + d        height of a point p over the floor, camera frame, m

with n the unit vector against gravity and d the height of the camera. What is not known is
estimated from the track; see `GroundEstimator`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.inference.arrays import Array

# Standard deviations of a direction and of a height that are given: of an inertial sensor and its
# mounting, rad, and of a measured height, m.
GIVEN_UP_SIGMA, GIVEN_HEIGHT_SIGMA = 0.01, 0.02
# The y axis of a camera points down; how far the direction of gravity is from it, rad.
UP_SIGMA = np.radians(15.0)


@dataclass(frozen=True)
class GroundSettings:
    """How far what is known of gravity and floor counts.

    Attributes:
        upright_weight: Factor on the prior of the lean of pelvis and trunk against the vertical; it
            replaces that of the root's angles, which are measured against the camera. 0 keeps them.
        floor_weight: Factor on the energy of feet below the floor; 0 switches it off.
        balance_weight: Factor on the energy of a centre of mass that is not over the feet; 0
            switches it off.
        contact_weight: Factor on the energy of resting feet that move; 0 switches it off.
    """

    upright_weight: float = 1.0
    floor_weight: float = 1.0
    balance_weight: float = 1.0
    contact_weight: float = 1.0

    def __post_init__(self) -> None:
        for name in ('upright_weight', 'floor_weight', 'balance_weight', 'contact_weight'):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f'ground.{name} must be a number of at least 0, saw {value}')

    @property
    def on(self) -> bool:
        """Whether any of the terms is on."""
        return bool(
            self.upright_weight or self.floor_weight or self.balance_weight or self.contact_weight
        )


@dataclass(frozen=True)
class KnownGround:
    """What is known of the ground besides the images.

    Attributes:
        up: (3,) unit vector against gravity in the camera frame; None: unknown.
        camera_height: height of the camera above the floor, m; None: unknown.

    Raises:
        ValueError: a direction that is no unit vector, or a height that is not positive.
    """

    up: Array | None = None
    camera_height: float | None = None

    def __post_init__(self) -> None:
        if self.up is not None:
            object.__setattr__(self, 'up', unit_vector(self.up))
        height = self.camera_height
        if height is not None and not (np.isfinite(height) and height > 0):
            raise ValueError(f'camera_height must be a positive number of metres, saw {height}')


@dataclass(frozen=True, eq=False)
class Ground:
    """The present estimate of the ground.

    Attributes:
        up: (3,) unit vector against gravity in the camera frame.
        up_sigma: standard deviation of its angle about each horizontal axis, rad.
        height: height of the camera above the floor, m; None: unknown.
        height_sigma: its standard deviation, m; inf where it is unknown.
    """

    up: Array
    up_sigma: float
    height: float | None
    height_sigma: float

    @property
    def plane(self) -> Array | None:
        """(4,) n and d with n . x + d = 0 on the floor; None: the height is unknown."""
        return None if self.height is None else np.append(self.up, self.height)


def unit_vector(up: ArrayLike) -> Array:
    """A direction (3,) of unit length.

    Raises:
        ValueError: another shape, or a length that is not 1 within 1 %.
    """
    vector = np.array(up, dtype=np.float64)
    length = float(np.linalg.norm(vector)) if vector.shape == (3,) else np.nan
    if not abs(length - 1.0) < 0.01:
        raise ValueError(
            f'up must be a unit vector (3,) against gravity in the camera frame, saw {vector}'
        )
    unit: Array = vector / length
    unit.setflags(write=False)
    return unit


class GroundEstimator:
    """Estimates the ground from what is known of it and from a track.

    Args:
        known: what is known; None: nothing.

    Attributes:
        estimate: the present one.
    """

    def __init__(self, known: KnownGround | None = None) -> None:
        self.known = known or KnownGround()
        self.reset()

    def reset(self) -> None:
        """Forgets what was estimated from a track."""
        given = self.known.up is not None
        height = self.known.camera_height
        self.estimate = Ground(
            np.array([0.0, -1.0, 0.0]) if self.known.up is None else self.known.up,
            GIVEN_UP_SIGMA if given else UP_SIGMA,
            height,
            np.inf if height is None else GIVEN_HEIGHT_SIGMA,
        )

    def set_gravity(self, up: ArrayLike) -> None:
        """Takes a newer direction (3,) against gravity, camera frame."""
        self.known = KnownGround(unit_vector(up), self.known.camera_height)
        old = self.estimate
        assert self.known.up is not None
        self.estimate = Ground(self.known.up, GIVEN_UP_SIGMA, old.height, old.height_sigma)
