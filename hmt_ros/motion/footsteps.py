"""Feet over a floor: a foot that stands, and one that walks; for motions that are made.

World of a `Viewpoint`: z up, floor at z = 0, m. A heading of 0 faces the camera; positive is to the
person's left.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.motion.smooth_curves import cubic

Array = NDArray[np.float64]

# A stride, in shares of its time, from one strike of the heel to the next.
BODY_ABOVE = 0.235  # the body passes the foot
HEEL_OFF, TOE_OFF = 0.30, 0.62
STRIKE, PUSH = np.radians(16.0), np.radians(-56.0)  # pitch of the foot, toe up
CLEARANCE = 0.02  # added to the arc of the ankle in the air, m of a body of the default size


def ahead(heading: Array | float) -> Array:
    """Unit vectors (..., 2) on the floor in which a person of a heading looks."""
    return np.stack([-np.sin(heading), np.cos(heading)], axis=-1)


def sole(body: Body) -> float:
    """Height of the ankle over the floor where the foot is flat, m."""
    names = body.skeleton.segment_names
    return max(p.radii[1] - p.centre[1] for p in body.flesh.parts if 'foot' in names[p.segment])


def standing_foot(
    body: Body, place: Array, up: Array | float, pitch: Array | float, heading: Array
) -> tuple[Array, Array]:
    """Ankle and toe (T, 3) of a foot.

    Args:
        body: whose foot it is.
        place: (T, 2) of the ankle on the floor.
        up: of the ankle, above where it is when the foot is flat, m.
        pitch: of the foot, toe up.
        heading: (T,) of the foot.
    """
    ankle = np.empty((len(place), 3))
    ankle[:, :2] = place
    ankle[:, 2] = sole(body) + up
    flat = (np.cos(pitch) * ahead(heading).T).T
    up_toe = np.broadcast_to(np.sin(pitch), heading.shape)
    return ankle, ankle + body.segment_lengths['foot'] * np.column_stack([flat, up_toe])


def walking_foot(
    body: Body, phase: Array, path: Callable[[Array], tuple[Array, Array]], aside: float
) -> tuple[Array, Array]:
    """Ankle and toe (T, 3) of a foot whose heel strikes where its phase is a whole number.

    Between the strike and the lift of the heel it stands still; until the toe leaves the floor it
    turns about the toe.

    Args:
        body: that walks.
        phase: (T,) increasing.
        path: place (..., 2) and heading of the body at phases.
        aside: distance of the foot to the right of the path, m.
    """
    foot = body.segment_lengths['foot']
    step = np.floor(phase)
    x = phase - step
    here, _ = path(step + BODY_ABOVE)
    there, _ = path(step + 1 + BODY_ABOVE)
    stride = np.linalg.norm(there - here, axis=1)

    rise = np.clip((x - HEEL_OFF) / (TOE_OFF - HEEL_OFF), 0.0, 1.0) ** 2
    pitch = np.where(x < HEEL_OFF, STRIKE * np.clip(1 - x / 0.08, 0, 1) ** 2, PUSH * rise)
    on_toe = x >= HEEL_OFF
    forth = np.where(on_toe, foot * (1 - np.cos(pitch)), 0.0)
    up = np.where(on_toe, -foot * np.sin(pitch), 0.0)

    # In the air it goes on from there, at the speed that it has.
    air = x >= TOE_OFF
    u = np.clip((x - TOE_OFF) / (1 - TOE_OFF), 0.0, 1.0)
    turning = PUSH * 2 / (TOE_OFF - HEEL_OFF) * (1 - TOE_OFF)
    pitch = np.where(air, cubic(u, PUSH, turning, STRIKE), pitch)
    start = foot * (1 - np.cos(PUSH)), foot * np.sin(PUSH) * turning
    forth = np.where(air, cubic(u, *start, stride), forth)
    start = -foot * np.sin(PUSH), -foot * np.cos(PUSH) * turning
    arc = cubic(u, *start, 0.0) + CLEARANCE * body.scale * np.sin(np.pi * u) ** 2
    up = np.where(air, arc, up)

    place, heading = path(step + BODY_ABOVE + forth / stride)
    # On the floor the foot keeps its heading.
    heading = np.where(air, heading, path(step + BODY_ABOVE)[1])
    return standing_foot(body, place + aside * ahead(heading - np.pi / 2), up, pitch, heading)
