"""Energy terms that depend on poses through the frames of the body's segments (KJS 2)."""

from __future__ import annotations

from typing import Protocol

from hmt_ros.body.kinematics import Frames
from hmt_ros.inference.arrays import Index
from hmt_ros.inference.energy import Derivatives, Energy


class FrameTerm(Protocol):
    """Interface of a custom energy term that depends on a pose through the segment frames."""

    def energy(
        self, frames: Frames, rows: Index, *, derivatives: Derivatives = Derivatives.POSITIVE
    ) -> Energy:
        """The energy of N poses.

        Args:
            rows: (N,) the problem that each pose belongs to, as for `EnergyTerm`.
            derivatives: requested derivatives with respect to the pose.
        """
        ...
