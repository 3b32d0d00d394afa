"""Training windows of keypoints: motions seen by random cameras and an imperfect detector.

A window is drawn from a track (`keypoint_tracks`), sometimes with trunk and arms of other tracks.
Random are its camera (heading, elevation, roll, distance, motion, a border that cuts the person),
image rate, speed of the motion, keypoint scheme, detector errors (`detector_errors`), and whether
gravity and the person's lengths are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_learning.training.detector_errors import Floats, with_errors
from hmt_learning.training.keypoint_tracks import (
    CENTRES,
    JOINTS,
    KeypointTracks,
    assembled,
    meet,
    proportions_of,
)
from hmt_learning.training.training_set import about
from hmt_ros.experts.lifter import (
    LANDMARKS,
    MIN_LANDMARKS,
    SUBSTITUTES,
    TIME_TOLERANCES,
    TIMES,
    window_inputs,
)
from hmt_ros.experts.pose_predictor import RATE
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.lifted_poses import HIPS
from hmt_ros.inference.arrays import Array, Index

# Indices of the landmarks that joint centres replace.
REPLACED = tuple(LANDMARKS.index(SUBSTITUTES[name]) for name in CENTRES)


@dataclass(frozen=True)
class WindowSettings:
    """Distribution of the random windows.

    Attributes:
        elevation, elevation_spread: mean and standard deviation of the angle by which the camera
            looks down, degrees.
        roll_spread: standard deviation of the camera's roll, degrees.
        unusual: share of cameras with extreme elevation and five times the roll.
        distances, near_distances: range of the person's distance, and for a near person, m.
        near: share of windows in which the person is near and cut by the lower border.
        borders: range of the lower border of such an image, tangent of the angle below the axis.
        recombined: share of windows with the trunk and the arms of another motion; in half of them
            the arms are of a third one.
        asynchronous: share of windows in which legs, trunk and arms are at different times, even
            of one motion.
        seated: share of windows of seated people.
        moving, speed: share of moving cameras, and standard deviation of their velocity, m/s.
        rates: range of images per second, log-uniform.
        usual_rate: share of windows with RATE images per second.
        speeds: range of the factor on the speed of the motion.
        noise: factor on the errors of the detector; 0 disables them.
        gravity, gravity_spread: share of windows with known gravity, and its error, degrees.
        lengths, lengths_spread: share of windows with known lengths, and their relative error.
        causal: share of windows without later images.
        cut: share of windows with a short past or future, as at the start of a track.
    """

    elevation: float = 8.0
    elevation_spread: float = 14.0
    roll_spread: float = 3.0
    unusual: float = 0.08
    distances: tuple[float, float] = (1.6, 10.0)
    near_distances: tuple[float, float] = (0.5, 1.6)
    near: float = 0.2
    borders: tuple[float, float] = (0.3, 0.7)
    recombined: float = 0.4
    asynchronous: float = 1.0
    seated: float = 0.08
    moving: float = 0.2
    speed: float = 0.5
    rates: tuple[float, float] = (2.0, 60.0)
    usual_rate: float = 0.6
    speeds: tuple[float, float] = (0.8, 1.25)
    noise: float = 1.0
    gravity: float = 0.6
    gravity_spread: float = 2.0
    lengths: float = 0.6
    lengths_spread: float = 0.03
    causal: float = 0.5
    cut: float = 0.2


def training_windows(
    tracks: KeypointTracks,
    count: int,
    rng: np.random.Generator,
    settings: WindowSettings | None = None,
    scheme: int | None = None,
) -> tuple[Floats, Floats]:
    """Random windows and the poses in them.

    Args:
        scheme: row of `SCHEMES` for all windows; None draws it for each.

    Returns:
        Inputs (N, p), and joints (N, J, 3) in the axes of a camera turned towards the person.
    """
    s = settings or WindowSettings()
    n, f32 = count, np.float32
    which = _drawn_tracks(tracks, n, rng, s)
    now = (_drawn_shares(which, rng, s) * tracks.counts[which]).astype(np.intp)
    times, there, rows, part = _images(now, tracks.counts[which], rng, s)
    base, first = tracks.starts[which][:, :, None] + rows, tracks.starts[which] + now
    joints = assembled(tracks, tracks.joints, JOINTS, first[..., None])[:, 0]
    # Intersecting parts are replaced by those of one motion; seated people may have hands on laps.
    met = meet(joints) & ~tracks.seated[which[0]]
    for one in (base, first, which, part):
        one[1:, met] = one[:1, met]
    joints[met] = assembled(tracks, tracks.joints, JOINTS, first[:, met, None])[:, 0]
    joints = joints - tracks.roots[first[0]][:, None]
    joints -= joints[:, [JOINTS.index(name) for name in HIPS]].mean(1, keepdims=True)
    places = assembled(tracks, tracks.landmarks, (*LANDMARKS, *CENTRES), base, part)
    root = tracks.roots[first[0]]
    chosen = rng.choice(len(SCHEMES), n, p=SHARES) if scheme is None else np.full(n, scheme)
    centres = OF_CENTRES[chosen]
    for i, row in enumerate(REPLACED):
        places[centres, :, row] = places[centres, :, len(LANDMARKS) + i]
    count_of = len(LANDMARKS)
    turn = _cameras(n, rng, s)
    places = places[:, :, :count_of] - root[:, None, None]
    places = (places.reshape(n, -1, 3) @ turn.transpose(0, 2, 1)).reshape(n, -1, count_of, 3)
    distance = np.exp(rng.uniform(np.log(s.distances[0]), np.log(s.distances[1]), n)).astype(f32)
    across = rng.uniform([-0.45, -0.35], [0.45, 0.35], (n, 2))
    near, border = rng.random(n) < s.near, np.full(n, np.inf)
    border[near] = rng.uniform(*s.borders, near.sum())
    distance[near] = rng.uniform(*s.near_distances, near.sum())
    # The pelvis is near the border.
    across[near, 1] = border[near] + rng.uniform(-0.35, 0.25, near.sum())
    ahead = np.concatenate([across, np.ones((n, 1))], axis=1).astype(f32)
    moves = s.speed * rng.normal(size=(n, 3)) * (rng.random(n) < s.moving)[:, None]
    places += (ahead * distance[:, None])[:, None, None]
    places += (moves[:, None] * times[..., None]).astype(f32)[:, :, None]
    rays = places[..., :2] / np.maximum(places[..., 2:], f32(0.25))
    confidences = there[..., None] * SCHEMES[chosen][:, None].astype(f32)
    if s.noise > 0:
        rays, confidences = with_errors(rays, confidences, distance, times, rng, s.noise, border)
    few = (confidences[:, 0] > 0).sum(1) < MIN_LANDMARKS
    confidences[few, 0] = np.maximum(confidences[few, 0], 0.9 * SCHEMES[chosen[few]])
    up = np.where(rng.random(n)[:, None] < s.gravity, -turn[:, :, 1], 0.0)
    for axis in (0, 2):
        tilt = about(axis, np.radians(s.gravity_spread * rng.normal(size=n)))
        up = np.einsum('nij,nj->ni', tilt, up)
    persons = proportions_of(tracks, which)
    persons = persons + s.lengths_spread * rng.normal(size=persons.shape)
    persons = np.where(rng.random(n)[:, None] < s.lengths, persons, 0.0)
    inputs = window_inputs(rays, confidences, times, up, persons)
    view = inputs.axes.astype(f32) @ turn
    return inputs.values, (joints @ view.transpose(0, 2, 1)).astype(f32)


def _drawn_tracks(
    tracks: KeypointTracks, n: int, rng: np.random.Generator, s: WindowSettings
) -> Index:
    """Tracks (3, N) of the legs, the trunk and the arms."""
    legs, trunk, arms = rng.choice(len(tracks.weights), (3, n), p=tracks.weights)
    seats = np.flatnonzero(tracks.seated)
    sits = (rng.random(n) < s.seated) & (len(seats) > 0)
    if sits.any():
        legs[sits] = rng.choice(seats, sits.sum())
    other, third = rng.random(n) < s.recombined, rng.random(n) < 0.5
    trunk = np.where(sits | other, trunk, legs)
    return np.stack([legs, trunk, np.where((sits | other) & third, arms, trunk)])


def _drawn_shares(which: Index, rng: np.random.Generator, s: WindowSettings) -> Array:
    """Current times in tracks (3, N), as fractions of their durations."""
    result: Array = rng.random(which.shape)
    together = rng.random(which.shape[1]) >= s.asynchronous
    for part in (1, 2):
        same = together & (which[part] == which[part - 1])
        result[part, same] = result[part - 1, same]
    return result


# Landmarks that schemes (rows) have, their frequencies, and whether they use joint centres.
_ON_SKIN = ('mediapipe33', 'coco17', 'body25', 'skeleton2d')


def _shown(scheme: str) -> NDArray[np.bool_]:
    names = {SUBSTITUTES.get(mark.name, mark.name) for mark in schemes()[scheme].landmarks}
    return np.array([name in names for name in LANDMARKS])


SCHEMES = np.stack([_shown(name) for name in (*_ON_SKIN, 'h36m17')])
SHARES = np.array([0.5, 0.2, 0.15, 0.05, 0.1])
OF_CENTRES = np.array([False] * len(_ON_SKIN) + [True])


def _images(
    now: Index, counts: Index, rng: np.random.Generator, s: WindowSettings
) -> tuple[Array, NDArray[np.bool_], Index, Floats]:
    """Times of images (N, S), their existence, frame indices, and interpolation weights.

    Args:
        now, counts: (3, N) current frames and numbers of frames of the tracks of the parts. Images
            end with the first track; shorter tracks of other parts are reflected in time.

    Returns:
        Times and existence (N, S); rows and weights of the next row (3, N, S).
    """
    n = now.shape[1]
    rate = np.exp(rng.uniform(np.log(s.rates[0]), np.log(s.rates[1]), n))
    rate[rng.random(n) < s.usual_rate] = RATE
    times = np.round(TIMES * rate[:, None]) / rate[:, None]
    there = np.abs(times - TIMES) <= TIME_TOLERANCES
    reach = float(TIMES.max())
    back = np.where(rng.random(n) < s.cut, rng.uniform(0.0, reach, n), np.inf)
    ahead = np.where(rng.random(n) < 0.5 * s.cut, rng.uniform(0.0, reach, n), np.inf)
    ahead[rng.random(n) < s.causal] = 0.0
    there &= (times >= -back[:, None] - 1e-6) & (times <= ahead[:, None] + 1e-6)
    at = now[..., None] + times * (RATE * rng.uniform(*s.speeds, (n, 1)))
    last = counts[..., None] - 1
    there &= (at[0] >= 0) & (at[0] <= last[0])
    at = np.clip(last - np.abs(last - np.abs(at)), 0, last)
    rows = np.minimum(np.floor(at).astype(np.intp), last - 1)
    return times, there, rows, (at - rows).astype(np.float32)


def _cameras(n: int, rng: np.random.Generator, s: WindowSettings) -> Floats:
    """Random rotations (N, 3, 3) of the person relative to the camera."""
    down = np.clip(s.elevation + s.elevation_spread * rng.normal(size=n), -35.0, 60.0)
    roll = s.roll_spread * rng.normal(size=n)
    far = rng.random(n) < s.unusual
    down[far] = rng.uniform(-40.0, 80.0, far.sum())
    roll[far] *= 5.0
    heading = rng.uniform(-np.pi, np.pi, n)
    turn = about(2, np.radians(roll)) @ about(0, np.radians(down)) @ about(1, heading)
    return turn.astype(np.float32)
