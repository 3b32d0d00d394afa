"""Assignment of people detected in an image to the tracked people.

    cost(i, j) = median_k |u_ik + v_i dt - p_jk| / s_i        over the common joints k

u_i are the last seen joints of person i, v_i is the person's velocity in the image, s_i the
person's size, and p_j are the joints of detection j. If person and detection have no common joints,
the centres of their boxes are used. A pair is possible if its cost is below a limit, which grows
with the time since the person was last seen. The assignment minimises the sum of costs; for a
person without a detection the cost is this limit.

Of two people, the nearer person hides the farther person. For the farther person, all pixels of the
nearer person are unknown. For the nearer person, pixels of the farther person are unknown only
outside the nearer person's own area.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from hmt_ros.core import elementary
from hmt_ros.image.person_shape import fill_hull, resized
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.inference.error_model import seconds

# Maximum cost of a pair just after a sighting, in sizes of the person; this limit doubles within
# `EXPECTED_TIME`.
GATE_COST = 0.4
# Time for which a person is assumed to keep the velocity, and the size if a part is hidden, s.
EXPECTED_TIME = 1.0
# Time constant of a person's mean velocity in the images, s.
VELOCITY_TIME = 0.25
# Margin around a person's mask or hull of keypoints, for the radius of limbs, as a fraction of the
# height.
LIMB_MARGIN = 0.05


@dataclass(frozen=True, eq=False)
class Sighting:
    """Position of a person in an image.

    Attributes:
        joints: pixels (2,) of the visible joints, by name.
        corners: (2, 2) top left and bottom right corner of the box around the person, px.
    """

    joints: dict[str, Array]
    corners: Array

    @classmethod
    def of(cls, keypoints: Keypoints, corners: Array) -> Sighting:
        """A sighting from a box and the seen keypoints, possibly none."""
        seen = np.flatnonzero(keypoints.seen)
        return cls({keypoints.names[i]: keypoints.pixels[i] for i in seen}, corners)

    @property
    def middle(self) -> Array:
        """Centre (2,) of the box, px."""
        return np.asarray(self.corners.mean(0))

    @property
    def size(self) -> float:
        """Diagonal of the box, px; at least 1."""
        return max(float(elementary.hypot(*(self.corners[1] - self.corners[0]))), 1.0)

    def shifts_to(self, other: Sighting) -> Array:
        """Shifts (n, 2) to another sighting, of common joints; if missing, of the box centre."""
        common = [name for name in self.joints if name in other.joints]
        if not common:
            return np.asarray((other.middle - self.middle)[None])
        return np.array([other.joints[name] - self.joints[name] for name in common])


class ImageTrack:
    """Last position and velocity of a person in the images.

    Args:
        sighting: first sighting.
        stamp: stamp of the sighting's image, ns.

    Attributes:
        sighting: last sighting.
        stamp: stamp of the sighting's image, ns.
        velocity: (2,) velocity in the image, px/s.
        size: size of the person, px; it shrinks slowly when a part of the person is hidden.
    """

    def __init__(self, sighting: Sighting, stamp: int) -> None:
        self.sighting, self.stamp = sighting, stamp
        self.velocity = np.zeros(2)
        self.size = sighting.size
        self._known_for = 0.0

    def update(self, sighting: Sighting, stamp: int) -> None:
        """Updates the track with a sighting in a later image."""
        dt = seconds(stamp - self.stamp)
        moved = np.median(self.sighting.shifts_to(sighting), axis=0)
        self._known_for += dt
        # The velocity is at first the mean over all sightings, later a mean over recent sightings.
        gain = min(dt / min(self._known_for, VELOCITY_TIME), 1.0)
        self.velocity += gain * (moved / dt - self.velocity)
        self.size = max(sighting.size, self.size * float(elementary.exp(-dt / EXPECTED_TIME)))
        self.sighting, self.stamp = sighting, stamp

    def shift(self, stamp: int) -> Array:
        """Expected displacement (2,) of the person since the last sighting, px."""
        dt = min(seconds(stamp - self.stamp), EXPECTED_TIME)
        return np.asarray(dt * self.velocity)

    def cost(self, sighting: Sighting, stamp: int) -> float:
        """Distance of a sighting from the expected position, in sizes of the person."""
        off = self.sighting.shifts_to(sighting) - self.shift(stamp)
        return float(np.median(elementary.hypot(*off.T))) / self.size

    def gate(self, stamp: int) -> float:
        """Association cost above which a sighting belongs to another person."""
        return GATE_COST * (1.0 + min(seconds(stamp - self.stamp) / EXPECTED_TIME, 1.0))


def assigned(
    tracks: Sequence[ImageTrack], sightings: Sequence[Sighting], stamp: int
) -> dict[int, int]:
    """Mapping from the index of each assigned track to the index of its sighting."""
    if not tracks or not sightings:
        return {}
    costs = np.array([[track.cost(each, stamp) for each in sightings] for track in tracks])
    gates = np.array([track.gate(stamp) for track in tracks])[:, None]
    # An impossible pair has the cost of a person without a detection.
    rows, columns = linear_sum_assignment(np.where(costs < gates, costs, gates))
    return {
        int(row): int(column)
        for row, column in zip(rows, columns, strict=True)
        if costs[row, column] < gates[row, 0]
    }


def unknown_area(mine: Mask, nearer: Sequence[Mask], farther: Sequence[Mask]) -> Mask | None:
    """Pixels (H, W) without evidence about a person because of other people; None if empty.

    Args:
        mine: (H, W) pixels that the person covers.
        nearer, farther: areas (H, W) of the people in front of and behind the person.
    """
    result = np.zeros_like(mine)
    for area in nearer:
        result |= area
    for area in farther:
        result |= area & ~mine
    return result if result.any() else None


def hull(sighting: Sighting, shape: tuple[int, ...]) -> Mask:
    """Pixels (H, W) in the hull of a person's joints, or in the box if joints are few, enlarged."""
    joints = np.array(list(sighting.joints.values()))
    if len(joints) < 3:
        (left, top), (right, bottom) = sighting.corners.tolist()
        joints = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
    mask = np.zeros(shape[:2], dtype=np.uint8)
    fill_hull(mask, joints)
    return grown(mask.view(np.bool_))


def grown(area: Mask) -> Mask:
    """An area (H, W) enlarged by the margin for limbs."""
    return resized(area, LIMB_MARGIN)


def moved(area: Mask, shift: Array) -> Mask:
    """An area (H, W) moved by a shift (2,) of whole pixels."""
    height, width = area.shape
    dx, dy = (int(x) for x in np.clip(np.rint(shift), -max(area.shape), max(area.shape)))
    result = np.zeros_like(area)
    if abs(dx) < width and abs(dy) < height:
        rows = slice(max(dy, 0), height + min(dy, 0)), slice(max(-dy, 0), height + min(-dy, 0))
        columns = slice(max(dx, 0), width + min(dx, 0)), slice(max(-dx, 0), width + min(-dx, 0))
        result[rows[0], columns[0]] = area[rows[1], columns[1]]
    return result
