"""The soles: where the flesh of the feet meets a floor, and where it rests.

The points of a foot are those of its flesh that lie farthest down when the foot is flat and pitched
by `PITCH` up (heel) or down (toe). They move with the flesh when the shape changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward, point_jacobians
from hmt_ros.inference.arrays import Array, Index

FEET = ('left', 'right')
# Pitch of the foot at which its heel and its toe are lowest, rad: 15 degrees.
PITCH = np.radians(15.0)
# Height of the ankle over the floor as a share of the stature, where a foot has no flesh [Winter,
# Biomechanics and Motor Control of Human Movement, 4th ed. 2009, figure 4.1].
ANKLE_HEIGHT = 0.039


@dataclass(frozen=True, eq=False)
class Soles:
    """Points of the soles: heel and toe of the left foot, then of the right one.

    Attributes:
        segments: (P,) that carry them; empty for a body without feet.
        local: (P, 3) in the frames of the segments, m.
        feet: (P,) 0: left, 1: right.
    """

    segments: Index
    local: Array
    feet: NDArray[np.intp]

    def __len__(self) -> int:
        return len(self.segments)


@lru_cache(maxsize=16)
def soles(body: Body) -> Soles:
    """The soles of a body; none where it lacks an ankle or a toe of either side."""
    names = body.joint_names
    wanted = [f'{side}_{joint}' for side in FEET for joint in ('ankle', 'toe')]
    if not set(wanted) <= set(names):
        nothing = np.zeros(0, dtype=np.intp)
        return Soles(nothing, np.zeros((0, 3)), nothing)
    joints = body.skeleton.joint_index(tuple(wanted)).reshape(2, 2)
    segments, local = [], []
    for ankle, toe in joints:
        carrier = int(body.skeleton.joint_segments[toe])
        down, ahead = _down_and_ahead(body, ankle, toe, carrier)
        points = body.flesh.points_on(carrier)
        if not len(points):
            own = body.skeleton.joint_offsets[toe]
            heel = own - ahead * float(ahead @ own)
            points = np.array([heel, own]) + ANKLE_HEIGHT * body.stature * down
        for sign in (-1.0, 1.0):
            lowest = points @ (np.cos(PITCH) * down + sign * np.sin(PITCH) * ahead)
            # The middle of the points that are lowest alike: left and right of the middle line.
            local.append(points[lowest > lowest.max() - 1e-6].mean(0))
            segments.append(carrier)
    feet = np.array([0, 0, 1, 1], dtype=np.intp)
    return Soles(np.array(segments, dtype=np.intp), np.array(local), feet)


def sole_points(body: Body, poses: Array) -> Array:
    """Points (N, P, 3) of the soles of poses (N, d), camera frame, m."""
    feet = soles(body)
    points = forward(body.skeleton, poses).points(feet.segments, feet.local)
    return np.ascontiguousarray(points.transpose(2, 0, 1))


def sole_jacobians(body: Body, poses: Array) -> Array:
    """Derivatives (N, P, 3, d) of the points of the soles with respect to the poses (N, d)."""
    feet, frames = soles(body), forward(body.skeleton, poses)
    found = point_jacobians(frames, feet.segments, frames.points(feet.segments, feet.local))
    return np.ascontiguousarray(found.transpose(3, 0, 2, 1))


def _down_and_ahead(body: Body, ankle: int, toe: int, carrier: int) -> tuple[Array, Array]:
    """Unit vectors towards the sole and the toe, in the frame of the foot.

    Towards the sole is where the shin points when all angles are 0, across the foot.
    """
    skeleton = body.skeleton
    frames = forward(skeleton, np.zeros((1, body.dimension)))
    joints, axes = frames.joints()[..., 0], frames.columns[carrier, ..., 0]
    parent = skeleton.parents[carrier]
    ahead = axes @ (joints[toe] - joints[ankle])
    ahead /= np.linalg.norm(ahead)
    shin = axes @ (joints[ankle] - frames.origins[parent, :, 0])
    down = shin - ahead * float(ahead @ shin)
    return down / np.linalg.norm(down), ahead
