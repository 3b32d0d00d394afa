"""How poses change from image to image: random walk or constant velocity (KJS fig. 4, step 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.skeleton import Skeleton

Array = NDArray[np.float64]

MODELS = ('random_walk', 'constant_velocity')


@dataclass(frozen=True)
class PoseRates:
    """How fast poses may change.

    Attributes:
        translation: standard deviation of the root's position after one second, m.
        root, trunk, hip, knee, shoulder, elbow, neck, extremity: of the angles, rad after one
            second. Deviations grow with the square root of time.
    """

    translation: float = 0.25
    root: float = 1.4
    trunk: float = 1.2
    hip: float = 1.3
    knee: float = 1.6
    shoulder: float = 2.2
    elbow: float = 2.2
    neck: float = 0.7
    extremity: float = 1.2

    def rates(self, skeleton: Skeleton) -> Array:
        """Variances (d,) that the degrees of freedom gain per second."""
        return np.array(
            [self._rate(n, r) for n, r in zip(skeleton.dof_names, skeleton.dof_is_rotation)]
        )

    def _rate(self, name: str, is_rotation: bool) -> float:
        if not is_rotation:
            return self.translation**2
        for key, words in (
            ('root', ('root',)),
            ('trunk', ('trunk', 'spine', 'clavicle', 'chest', 'abdomen')),
            ('neck', ('neck', 'head')),
            ('hip', ('hip', 'thigh', 'upleg')),
            ('knee', ('knee', 'shin', 'leg')),
            ('shoulder', ('shoulder', 'upper_arm', 'humerus')),
            ('elbow', ('elbow', 'forearm', 'radius')),
        ):
            if any(word in name.lower() for word in words):
                value = float(getattr(self, key))
                return (0.25 * value) ** 2 if 'clavicle' in name else value**2
        return self.extremity**2


@dataclass(frozen=True)
class DynamicsSettings(PoseRates):
    """Motion model.

    Attributes:
        model: 'random_walk', or 'constant_velocity' with the velocity of the mode.
        velocity_kept: share of the velocity that lasts from one image to the next; 1: all.
        velocity_gain: how far the velocity follows the newest displacement, 0 to 1.
        translation: standard deviation of the root's position after one second, m.
        root, trunk, hip, knee, shoulder, elbow, neck, extremity: of the angles, rad after one
            second. Deviations grow with the square root of time.
    """

    model: str = 'constant_velocity'
    velocity_kept: float = 0.7
    velocity_gain: float = 0.5

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise ValueError(f'dynamics must be one of {MODELS}, saw {self.model!r}')
        for name in ('velocity_kept', 'velocity_gain'):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f'{name} must lie in [0, 1], saw {getattr(self, name)}')


def predict(
    settings: DynamicsSettings,
    rates: Array,
    means: Array,
    covariances: Array,
    velocities: Array,
    dt: float,
) -> tuple[Array, Array]:
    """Means (K, d) and covariances (K, d, d) of the modes after dt seconds.

    Args:
        settings: the motion model.
        rates: (d,) variances gained per second.
        means, covariances: of the modes.
        velocities: (K, d) per second.
        dt: time since the last image, s.
    """
    moved = means
    if settings.model == 'constant_velocity':
        moved = means + settings.velocity_kept * dt * velocities
    return moved, covariances + np.diag(rates * dt)


def update_velocities(
    settings: DynamicsSettings, velocities: Array, before: Array, after: Array, dt: float
) -> Array:
    """Velocities (M, d) of modes that moved from `before` to `after` (M, d) in dt seconds."""
    gain = settings.velocity_gain
    return (1.0 - gain) * velocities + gain * (after - before) / dt
