"""Motion of the person in the demonstration, one take of fifteen seconds.

The person stands, points at the camera, then aside, leaves the image, comes back, and sits
down behind a desk that hides the legs.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from hmt_learning.motion.limb_motions import (
    SIGNS,
    Posture,
    ahead,
    arm_posture,
    sole,
    standing_foot,
)
from hmt_learning.motion.procedural_motion import (
    DEGREE,
    Plan,
    between,
    hanging,
    rests,
    steps,
    swinging_arms,
)
from hmt_ros.body.body import Body
from hmt_ros.inference.arrays import Array

SECONDS = 15.0
# End of each scene, s: points, walks out of the image and back, sits at the desk.
SCENES = {'points': 4.4, 'walks': 11.5, 'sits': SECONDS}
STOOL, SEAT = (0.85, -0.40), 0.45  # position of the stool on the floor, and its height, m
DESK = (0.85, 0.62)  # position on the floor, m
# Path on the floor: time, s; position, m; heading, deg.
WAY = np.array([
    [-1.0, -0.45, 0.00, 8], [4.4, -0.45, 0.00, 8], [5.0, -0.62, -0.01, 60],
    [5.5, -1.10, -0.03, 88], [6.9, -2.60, -0.10, 90], [7.2, -2.70, -0.12, 60],
    [7.6, -2.70, -0.15, -80], [8.2, -2.25, -0.15, -90], [10.3, 0.62, -0.10, -86],
    [10.8, 0.84, -0.06, -30], [11.2, 0.85, -0.05, 0], [17.0, 0.85, -0.05, 0],
])  # fmt: skip
STEP, AIR = 0.45, 0.95 * 0.45  # duration of a step, and of its part in the air, s
WALK = (4.5, 11.4)  # start and end of walking, s
APART, LIFT = 0.085, 0.06  # distance of a foot from the path, and its height in the air, m
SITS = (11.3, 12.4)  # start and end of sitting down, s
# Directions of the right upper arm and forearm: to the person's right, ahead, up.
AT_CAMERA = ((0.30, 0.80, -0.52), (0.02, 0.99, 0.10))
ASIDE = ((0.97, 0.15, -0.20), (0.98, 0.20, 0.00))


def demonstration(
    body: Body, time: Array, duration: float, heading: float | None, rng: np.random.Generator
) -> Plan:
    """The plan of all scenes, without random parts."""
    del duration, heading, rng
    feet = [_foot(body, time, side) for side in range(2)]
    place, direction = way(time)
    angles = {'root_z': gaussian_filter1d(direction, 0.08 / (time[1] - time[0]))}
    angles |= _arms(body, time)
    sitting = rests(time, SITS, [0.0, 1.0])
    bowed = sitting * (1.0 - sitting) * 4.0
    speed = np.linalg.norm(np.gradient(place, time, axis=0), axis=1)
    angles['root_x'] = (-2 - 2 * np.minimum(speed, 1.0) - 24 * bowed - 3 * sitting) * DEGREE
    angles['trunk_x'] = (-2 - 12 * bowed - 6 * sitting) * DEGREE
    lengths = body.segment_lengths
    upright = lengths['hip_drop'] + lengths['thigh'] + lengths['shin'] + sole(body)
    seated = SEAT + 0.09 + lengths['hip_drop']
    pelvis = np.empty((len(time), 3))
    pelvis[:, :2] = place + sitting[:, None] * (np.add(STOOL, [0.0, 0.03]) - way(SITS[1])[0])
    pelvis[:, 2] = upright + 0.1 + sitting * (seated - upright - 0.1)
    return pelvis, angles, feet


def way(time: Array | float) -> tuple[Array, Array]:
    """Position (..., 2) on the floor, m, and heading (...), rad."""
    found = PchipInterpolator(WAY[:, 0], WAY[:, 1:])(time)
    return found[..., :2], found[..., 2] * DEGREE


def _foot(body: Body, time: Array, side: int) -> tuple[Array, Array]:
    """Ankle and toe (T, 3) of a foot that lands beside the path, slightly ahead of the body."""
    start, end = WALK
    landings = np.append(-1.0, np.arange(start + STEP * (1 + side), end + STEP, 2 * STEP))
    places, headings = way(landings + 0.5 * STEP)
    places = places + SIGNS[side] * APART * ahead(headings - np.pi / 2)
    far = np.minimum(np.linalg.norm(np.diff(places, axis=0), axis=1) / 0.5, 1.0)
    lift = LIFT * (0.4 + 0.6 * far)
    floor, yaw, up = steps(time, landings, AIR, places, headings, lift)
    pitch = -np.clip(up / LIFT, 0.0, 1.0) * 25 * DEGREE
    return standing_foot(body, floor, up, pitch, yaw - SIGNS[side] * 6 * DEGREE)


def _arms(body: Body, time: Array) -> dict[str, Array]:
    """Angles (T,) of both arms."""
    rest_upper = [hanging(3 * DEGREE, 9 * DEGREE * sign) for sign in SIGNS]
    rest_fore = [hanging(18 * DEGREE, 4 * DEGREE * sign) for sign in SIGNS]

    def right(upper: ArrayLike, fore: ArrayLike) -> Posture:
        return arm_posture(body, [rest_upper[0], _unit(upper)], [rest_fore[0], _unit(fore)])

    def both(*parts: ArrayLike) -> Posture:
        return arm_posture(
            body, *([_unit(np.multiply(x, [sign, 1, 1])) for sign in SIGNS] for x in parts)
        )

    rest = arm_posture(body, rest_upper, rest_fore)
    camera, aside = right(*AT_CAMERA), right(*ASIDE)
    table = both((0.25, 0.45, -0.85), (-0.15, 0.95, 0.0))
    far = both((0.15, 0.75, -0.62), (-0.25, 0.96, 0.05))
    angles = between(
        time,
        [-1, 1.0, 1.8, 2.8, 3.5, 3.8, 4.6, 11.8, 12.6, 13.2, 13.9, 14.3, 15.2],
        [rest, rest, camera, camera, aside, aside, rest, rest, table, table, far, far, table],
    )
    start, end = WALK
    swing = rests(time, [start + 0.3, start + 0.9, end - 0.9, end - 0.3], [0.0, 1.0, 1.0, 0.0])
    lead = swing * np.cos(np.pi * (time - start - STEP) / STEP)
    for name, walking in swinging_arms(body, 20 * DEGREE, lead).items():
        angles[name] = angles[name] + swing * (walking - rest[name])
    return angles


def _unit(direction: ArrayLike) -> Array:
    """The direction, normalised."""
    return np.asarray(direction / np.linalg.norm(direction))
