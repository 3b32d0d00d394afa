"""Windows of keypoints to learn from: motions seen by random cameras and a detector that errs.

Recorded motions become tracks of landmarks: of the person who was recorded, mirrored, of other
proportions, with the trunk and arms of another motion, with angles that wander. A window is drawn
from a track: its camera (heading, height, pitch, roll, distance, maybe moving), the rate of its
images, the speed of the motion, the scheme of the detector, its errors, the knowledge of gravity
and of the person's lengths. Errors of detectors are in `image/keypoint_schemes.yaml`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from hmt_learning.training.training_set import LEGS, PoseSequence, about
from hmt_ros.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import mirror
from hmt_ros.body.skeleton import other_side
from hmt_ros.experts.lifter import (
    FEWEST,
    INSTEAD,
    LANDMARKS,
    NEAR,
    TIMES,
    landmark_offsets,
    proportions,
    window_inputs,
)
from hmt_ros.experts.pose_encoding import AXES
from hmt_ros.experts.pose_predictor import RATE
from hmt_ros.image.keypoint_schemes import landmarks, schemes
from hmt_ros.image.lifted_poses import HIPS
from hmt_ros.inference.arrays import Array, Index

Floats = NDArray[np.float32]

# Joints of the poses that are learned.
JOINTS = (
    'neck',
    'head',
    *(
        f'{side}_{name}'
        for name in ('shoulder', 'elbow', 'wrist', 'hip', 'knee', 'ankle', 'toe', 'hand')
        for side in ('left', 'right')
    ),
    'pelvis',
)
# Landmarks of schemes of joint centres, behind those on the skin, and the rows that they replace.
CENTRES = tuple(name for name in INSTEAD if name != 'centre_of_neck')
REPLACED = tuple(LANDMARKS.index(INSTEAD[name]) for name in CENTRES)
SIDES = np.array([LANDMARKS.index(other_side(name)) for name in LANDMARKS])
ARMS = np.array([name.endswith(('shoulder', 'elbow', 'wrist')) for name in LANDMARKS])
BELOW_KNEE = np.array([name.endswith(('knee', 'ankle', 'heel', 'toe')) for name in LANDMARKS])
BELOW_HIP = BELOW_KNEE | np.array([name.endswith('hip') for name in LANDMARKS])
OF_LEGS = BELOW_KNEE | np.array([name in HIPS for name in LANDMARKS])

# Tracks of each motion; from the third on angles wander and trunks are mixed.
VARIANTS, PLAIN = 4, 2
# Least deviation of the places of landmarks over people, clothes and detectors, m.
LEAST_SIGMA = 0.022
# Share of the spread of lengths over people by which a variant differs; a length keeps this share.
OF_SPREAD, SHORTEST_LENGTH = 0.8, 0.4
# Angles that wander: standard deviations of joints, and of the lean of root and trunk; time, s.
WANDER, LEAN, WANDERING = np.radians(7.0), np.radians(4.0), 2.0
SHORTEST = 10  # frames of a motion


@dataclass(frozen=True)
class DetectorErrors:
    """How the keypoints of a detector err together.

    `sigma`, how much of the variance lasts and how often sides are exchanged are near what
    `benchmarks keypoint_noise` measures on rendered clips; the rest is chosen.

    Attributes:
        sigma: Standard deviation of a keypoint that is sure, m at the person.
        spread: Standard deviation of its logarithm over persons.
        white, lasting, constant: Shares of the variance of errors that differ from image to image,
            that last for `time`, and that stay.
        time: Time for which the second kind lasts, s.
        hidden, always_hidden: Shares of the landmarks that are unsure for a while, and always.
        hidden_time: Half of that while, s.
        hidden_factor: Largest factor on the errors of an unsure landmark.
        heavy: Share of the landmarks that err as much although they seem sure.
        unconfident: Share of detectors that have no confidences.
        missing: Share of landmarks, of single keypoints and of images that are missing.
        cut: Share of windows in which the border of the image cuts the person.
        exchanged: Shares of windows where nothing, all, arms, legs are called by the other side.
        exchange_time: Half of the time for which they are, s; half of them stay.
    """

    sigma: float = 0.016
    spread: float = 0.35
    white: float = 0.08
    lasting: float = 0.64
    constant: float = 0.25
    time: float = 0.2
    hidden: float = 0.12
    always_hidden: float = 0.04
    hidden_time: float = 0.5
    hidden_factor: float = 6.0
    heavy: float = 0.03
    unconfident: float = 0.2
    missing: float = 0.02
    cut: float = 0.06
    exchanged: tuple[float, ...] = (0.91, 0.04, 0.025, 0.025)
    exchange_time: float = 0.3


@dataclass(frozen=True)
class WindowSettings:
    """The distribution that windows are drawn from.

    Attributes:
        elevation, elevation_spread: angle by which the camera looks down, degrees.
        roll_spread: of the camera, degrees.
        unusual: share of cameras from far above or below, that roll.
        distances: of the person, m.
        moving, speed: share of cameras that move, and their speed, m/s.
        rates: images a second, drawn evenly on a logarithmic scale.
        usual_rate: share of windows of 30 images a second.
        speeds: factor on the speed of the motion.
        noise: factor on the errors of the detector; 0: it does not err.
        gravity, gravity_spread: share of windows where it is known, and its error, degrees.
        lengths, lengths_spread: share of windows where the lengths are known, and their error.
        causal: share of windows without later images.
        cut: share of windows whose past or future is short, as where a track starts.
    """

    elevation: float = 8.0
    elevation_spread: float = 14.0
    roll_spread: float = 3.0
    unusual: float = 0.08
    distances: tuple[float, float] = (1.6, 10.0)
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


@dataclass(frozen=True, eq=False)
class KeypointTracks:
    """Tracks of landmarks, F frames in all, RATE a second.

    Attributes:
        places: (F, L + C, 3) landmarks, and centres of joints that schemes may have instead, m.
        joints: (F, J, 3) of a person of the usual lengths from the middle of the hips, m.
        roots: (F, 3) of the person, m.
        starts, counts: (M,) first frame and number of frames of each track.
        persons: (M, P) proportions (`lifter.proportions`).
        weights: (M,) share of the windows that are drawn from a track; they sum to 1.
    """

    places: Floats
    joints: Floats
    roots: Floats
    starts: Index
    counts: Index
    persons: Array
    weights: Array


def keypoint_tracks(
    body: Body,
    sequences: Sequence[PoseSequence],
    shares: Sequence[float],
    *,
    variants: int = VARIANTS,
    seed: int = 0,
) -> KeypointTracks:
    """Tracks of motions, with variants.

    Args:
        body: with the usual lengths.
        shares: of each motion among the windows, beside the square root of its length.
        variants: number of tracks of each motion; the first is the motion itself.

    Raises:
        ValueError: no motion is long enough.
    """
    rng = np.random.default_rng(seed)
    usable = [(x, s) for x, s in zip(sequences, shares, strict=True) if len(x.poses) >= SHORTEST]
    if not usable:
        raise ValueError(f'no motion has {SHORTEST} frames')
    others = [x.poses for x, _ in usable]
    which = body.skeleton.joint_index(JOINTS)
    hips = [JOINTS.index(name) for name in HIPS]
    places, joints, roots, persons, weights = [], [], [], [], []
    for sequence, share in usable:
        for variant in range(variants):
            poses, lengths = sequence.poses, sequence.lengths
            if variant % 2:
                poses = mirror(body, poses)
            if variant >= PLAIN:
                poses = _varied(body, poses, others, rng)
            if variant:
                lengths = _other_lengths(body, lengths, rng)
            own = body.with_segment_lengths(lengths)
            centre = poses[:, :3].mean(0)
            placed = _places(own, poses, rng if variant else None) - centre
            usual = body.joint_positions(poses)[:, which]
            places.append(placed.astype(np.float32))
            joints.append((usual - usual[:, hips].mean(1, keepdims=True)).astype(np.float32))
            roots.append((poses[:, :3] - centre).astype(np.float32))
            persons.append(proportions(body, own.segment_lengths))
            weights.append(share * np.sqrt(len(poses)))
    counts = np.array([len(x) for x in roots], dtype=np.intp)
    return KeypointTracks(
        np.concatenate(places),
        np.concatenate(joints),
        np.concatenate(roots),
        np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.intp),
        counts,
        np.array(persons),
        np.array(weights) / np.sum(weights),
    )


def _other_lengths(
    body: Body, lengths: dict[str, float], rng: np.random.Generator
) -> dict[str, float]:
    """Lengths of a person of another size and other proportions, as the body says people have."""
    names = body.skeleton.length_names
    factor = np.linalg.cholesky(body.length_covariance + 1e-12 * np.eye(len(names)))
    other = OF_SPREAD * factor @ rng.normal(size=len(names))
    return {
        name: max(lengths[name] + more, SHORTEST_LENGTH * lengths[name])
        for name, more in zip(names, other.tolist(), strict=True)
    }


def _varied(body: Body, poses: Array, others: Sequence[Array], rng: np.random.Generator) -> Array:
    """Poses whose angles wander, half of them with trunk and arms of another motion."""
    poses, names = poses.copy(), body.dof_names
    upper = np.array(
        [i >= AXES and not any(leg in name for leg in LEGS) for i, name in enumerate(names)]
    )
    if rng.random() < 0.5:
        other = others[int(rng.integers(len(others)))]
        # Played forth and back.
        rows = (rng.integers(len(other)) + np.arange(len(poses))) % (2 * len(other))
        rows = np.where(rows < len(other), rows, 2 * len(other) - 1 - rows)
        poses[:, upper] = other[rows][:, upper]
    keep = np.exp(-1.0 / (WANDERING * RATE))
    drawn = np.sqrt(1.0 - keep**2) * rng.normal(size=poses.shape)
    drawn[0] /= np.sqrt(1.0 - keep**2)
    size = np.where(body.skeleton.dof_is_rotation, WANDER, 0.0)
    size[3] = 0.0
    size[4:AXES] = LEAN
    size[[name.startswith('trunk') for name in names]] = LEAN
    wandering = size * lfilter([1.0], [1.0, -keep], drawn, axis=0)
    return np.asarray(np.clip(poses + wandering, body.lower, body.upper))


def _places(body: Body, poses: Array, rng: np.random.Generator | None) -> Array:
    """Landmarks and centres (T, L + C, 3) of a person; rng: their places vary by person."""
    names = (*LANDMARKS, *CENTRES)
    joints, offsets = landmark_offsets(body, names)
    if rng is not None:
        sigma = np.array([max(landmarks()[name].sigma, LEAST_SIGMA) for name in names])
        offsets = offsets + sigma[:, None] * rng.normal(size=offsets.shape)
    skeleton = body.skeleton
    which = skeleton.joint_index(tuple(joints))
    points = forward(skeleton, poses).points(
        skeleton.joint_segments[which], skeleton.joint_offsets[which] + offsets
    )
    return np.asarray(points.transpose(2, 0, 1))


def training_windows(
    tracks: KeypointTracks,
    count: int,
    rng: np.random.Generator,
    settings: WindowSettings | None = None,
    scheme: int | None = None,
) -> tuple[Floats, Floats]:
    """Random windows and the poses in them.

    Args:
        scheme: row of `SCHEMES`; None: all of them.

    Returns:
        Inputs (N, p), and joints (N, J, 3) along the axes of a camera that looks at the person.
    """
    s = settings or WindowSettings()
    n, f32 = count, np.float32
    which = rng.choice(len(tracks.counts), n, p=tracks.weights)
    counts, starts = tracks.counts[which], tracks.starts[which]
    now = (rng.random(n) * counts).astype(np.intp)
    times, there, rows, part = _images(now, counts, rng, s)
    base = starts[:, None] + rows
    places = tracks.places[base] * (1 - part) + tracks.places[base + 1] * part
    root = tracks.roots[starts + now]
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
    ahead = np.concatenate([across, np.ones((n, 1))], axis=1).astype(f32)
    moves = s.speed * rng.normal(size=(n, 3)) * (rng.random(n) < s.moving)[:, None]
    places += (ahead * distance[:, None])[:, None, None]
    places += (moves[:, None] * times[..., None]).astype(f32)[:, :, None]
    rays = places[..., :2] / np.maximum(places[..., 2:], f32(0.25))
    confidences = there[..., None] * SCHEMES[chosen][:, None].astype(f32)
    if s.noise > 0:
        rays, confidences = with_errors(rays, confidences, distance, times, rng, s.noise)
    few = (confidences[:, 0] > 0).sum(1) < FEWEST
    confidences[few, 0] = np.maximum(confidences[few, 0], 0.9 * SCHEMES[chosen[few]])
    up = np.where(rng.random(n)[:, None] < s.gravity, -turn[:, :, 1], 0.0)
    for axis in (0, 2):
        tilt = about(axis, np.radians(s.gravity_spread * rng.normal(size=n)))
        up = np.einsum('nij,nj->ni', tilt, up)
    persons = tracks.persons[which]
    persons = persons + s.lengths_spread * rng.normal(size=persons.shape)
    persons = np.where(rng.random(n)[:, None] < s.lengths, persons, 0.0)
    inputs = window_inputs(rays, confidences, times, up, persons)
    view = inputs.axes.astype(f32) @ turn
    joints = np.einsum('nij,nkj->nki', view, tracks.joints[starts + now])
    return inputs.values, joints.astype(f32)


# Landmarks (rows) that schemes have, how often each is drawn, and which are of joint centres.
_ON_SKIN = ('mediapipe33', 'coco17', 'body25', 'skeleton2d')


def _shown(scheme: str) -> NDArray[np.bool_]:
    names = {INSTEAD.get(mark.name, mark.name) for mark in schemes()[scheme].landmarks}
    return np.array([name in names for name in LANDMARKS])


SCHEMES = np.stack([_shown(name) for name in (*_ON_SKIN, 'h36m17')])
SHARES = np.array([0.5, 0.2, 0.15, 0.05, 0.1])
OF_CENTRES = np.array([False] * len(_ON_SKIN) + [True])


def _images(
    now: Index, counts: Index, rng: np.random.Generator, s: WindowSettings
) -> tuple[Array, NDArray[np.bool_], Index, Floats]:
    """Times of images (N, S), whether there are any, rows of frames, share of the next frame."""
    n = len(now)
    rate = np.exp(rng.uniform(np.log(s.rates[0]), np.log(s.rates[1]), n))
    rate[rng.random(n) < s.usual_rate] = RATE
    times = np.round(TIMES * rate[:, None]) / rate[:, None]
    there = np.abs(times - TIMES) <= NEAR
    reach = float(TIMES.max())
    back = np.where(rng.random(n) < s.cut, rng.uniform(0.0, reach, n), np.inf)
    ahead = np.where(rng.random(n) < 0.5 * s.cut, rng.uniform(0.0, reach, n), np.inf)
    ahead[rng.random(n) < s.causal] = 0.0
    there &= (times >= -back[:, None] - 1e-6) & (times <= ahead[:, None] + 1e-6)
    at = now[:, None] + times * RATE * rng.uniform(*s.speeds, n)[:, None]
    last = counts[:, None] - 1
    there &= (at >= 0) & (at <= last)
    at = np.clip(at, 0, last)
    rows = np.minimum(np.floor(at).astype(np.intp), last - 1)
    return times, there, rows, (at - rows).astype(np.float32)[..., None, None]


def _cameras(n: int, rng: np.random.Generator, s: WindowSettings) -> Floats:
    """Rotations (N, 3, 3) of the person in front of the camera."""
    down = np.clip(s.elevation + s.elevation_spread * rng.normal(size=n), -35.0, 60.0)
    roll = s.roll_spread * rng.normal(size=n)
    far = rng.random(n) < s.unusual
    down[far] = rng.uniform(-40.0, 80.0, far.sum())
    roll[far] *= 5.0
    heading = rng.uniform(-np.pi, np.pi, n)
    turn = about(2, np.radians(roll)) @ about(0, np.radians(down)) @ about(1, heading)
    return turn.astype(np.float32)


def with_errors(
    rays: Floats,
    confidences: Floats,
    distance: Floats,
    times: Array,
    rng: np.random.Generator,
    amount: float = 1.0,
) -> tuple[Floats, Floats]:
    """Rays (N, S, L, 2) and confidences (N, S, L) as a detector would see them.

    Args:
        rays, confidences: as they are; confidence 0: the scheme lacks a landmark, or there is no
            image.
        distance: (N,) of the person, m.
        times: (N, S) of the images, s; the same order in all windows.
        amount: factor on the deviations.
    """
    e = DetectorErrors()
    n, s, count = confidences.shape
    f32 = np.float32

    def normal(*shape: int) -> Floats:
        return rng.standard_normal(shape, dtype=f32)

    sigma = e.sigma * amount * np.exp(e.spread * rng.normal(size=n)) / distance
    noise = np.sqrt(f32(e.white)) * normal(n, s, count, 2)
    noise += np.sqrt(f32(e.constant)) * normal(n, 1, count, 2)
    lasting, order = normal(n, s, count, 2), np.argsort(TIMES)
    for before, after in pairwise(order.tolist()):
        gap = np.abs(times[:, after] - times[:, before])
        rho = np.exp(-gap / e.time).astype(f32)[:, None, None]
        lasting[:, after] *= np.sqrt(1 - rho * rho)
        lasting[:, after] += rho * lasting[:, before]
    noise += np.sqrt(f32(e.lasting)) * lasting
    # Landmarks that are hidden, for a while or all the time, and those that err without saying so.
    reach = float(TIMES.max()) + 0.1
    middle, half = (
        rng.uniform(-reach, reach, (n, 1, count)),
        rng.exponential(e.hidden_time, (n, 1, count)),
    )
    hidden = (rng.random((n, 1, count)) < e.hidden) & (np.abs(times[:, :, None] - middle) < half)
    hidden |= rng.random((n, 1, count)) < e.always_hidden
    factor = np.where(hidden, rng.uniform(1.5, e.hidden_factor, (n, 1, count)), 1.0)
    heavy = rng.random((n, 1, count)) < e.heavy
    factor = factor * np.where(heavy, rng.uniform(2.0, 5.0, (n, 1, count)), 1.0)
    rays = rays + (sigma[:, None, None] * factor)[..., None].astype(f32) * noise
    doubt = 0.75 - 0.12 * factor + 0.15 * normal(n, 1, count) + 0.05 * normal(n, s, count)
    sure = np.where(
        hidden, np.clip(doubt, 0.02, 0.9), np.clip(1 - 0.04 * np.abs(normal(n, s, count)), 0.5, 1)
    )
    sure = np.where(rng.random((n, 1, 1)) < e.unconfident, 1.0, sure)
    confidences = confidences * sure.astype(f32)
    confidences *= ~(hidden & (rng.random((n, 1, 1)) < 0.3))
    for shape in ((n, 1, count), (n, s, count), (n, s, 1)):
        confidences *= rng.random(shape) > e.missing
    for share, below in ((e.cut, BELOW_KNEE), (0.5 * e.cut, BELOW_HIP)):
        confidences[rng.random(n) < share] *= ~below
    _exchange(rays, confidences, times, rng, e)
    return rays.astype(f32), confidences


def _exchange(
    rays: Floats, confidences: Floats, times: Array, rng: np.random.Generator, e: DetectorErrors
) -> None:
    """Exchanges left and right in some windows: for a run of images, or for all of them."""
    n = len(rays)
    kind = rng.choice(4, n, p=e.exchanged)
    whole, reach = rng.random(n) < 0.5, float(TIMES.max()) + 0.2
    middle, half = rng.uniform(-reach, reach, n), rng.exponential(e.exchange_time, n)
    for number, group in ((1, np.ones(len(LANDMARKS), np.bool_)), (2, ARMS), (3, OF_LEGS)):
        rows = np.flatnonzero(kind == number)
        order = np.where(group, SIDES, np.arange(len(LANDMARKS)))
        on = whole[rows, None] | (np.abs(times[rows] - middle[rows, None]) < half[rows, None])
        rays[rows] = np.where(on[..., None, None], rays[rows][:, :, order], rays[rows])
        confidences[rows] = np.where(
            on[..., None], confidences[rows][:, :, order], confidences[rows]
        )
