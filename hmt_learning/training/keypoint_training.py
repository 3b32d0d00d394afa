"""Windows of keypoints to learn from: motions seen by random cameras and a detector that errs.

Recorded motions become tracks of landmarks: of the person who was recorded, mirrored, of other
proportions, with angles that wander, and of people who sit. A window is drawn from a track, with
the trunk and arms of other tracks in some windows: its camera (heading, height, pitch, roll,
distance, maybe moving, whether its border cuts the person), the rate of its images, the speed of
the motion, the scheme of the detector, its errors, the knowledge of gravity and of the person's
lengths. Errors of detectors are in `image/keypoint_schemes.yaml`.

    p_legs = r + R l        p_trunk = r + R t        p_arm = r + R (s + C a)

r, R are place and turn of the pelvis; l, t, s places of legs, trunk and shoulder in its frame; C is
the turn of the chest in that frame, a the place of an arm from its shoulder in the chest's.
Legs with r and R, trunk with s and C, and arms may be of three tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

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
    PROPORTIONED,
    TIMES,
    landmark_offsets,
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
SHOULDERS = ('left_shoulder', 'right_shoulder')
BELOW_KNEE = np.array([name.endswith(('knee', 'ankle', 'heel', 'toe')) for name in LANDMARKS])
BELOW_HIP = BELOW_KNEE | np.array([name.endswith('hip') for name in LANDMARKS])
OF_LEGS = BELOW_KNEE | np.array([name in HIPS for name in LANDMARKS])

# Tracks of each motion; from the third on angles wander.
VARIANTS, PLAIN = 4, 2
# Segments of the pelvis and of the chest.
PELVIS, CHEST = 0, 1
# Tracks of people who sit, and their frames; mean and deviation of the angles of hips, knees and of
# the lean of the pelvis; deviation of other angles of the legs, degrees.
SEATED, SEATED_FRAMES = 48, 240
SEATED_HIP, SEATED_KNEE, SEATED_LEAN, SEATED_OTHER = (85.0, 12.0), (-88.0, 22.0), 9.0, 8.0
# A wrist, an elbow or a hand is no nearer to an axis of the trunk or of a leg, m.
TRUNK_RADIUS, LEG_RADIUS = 0.10, 0.07
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
        cut: Shares of windows without what is below the knees, and below the hips.
        beyond: Factor on the errors of a landmark beyond the border, by the tangent of the angle.
        doubted: Loss of confidence there, by the same; half of the detectors leave it out.
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
    cut: tuple[float, float] = (0.08, 0.08)
    beyond: float = 12.0
    doubted: float = 3.2
    exchanged: tuple[float, ...] = (0.91, 0.04, 0.025, 0.025)
    exchange_time: float = 0.3


@dataclass(frozen=True)
class WindowSettings:
    """The distribution that windows are drawn from.

    Attributes:
        elevation, elevation_spread: angle by which the camera looks down, degrees.
        roll_spread: of the camera, degrees.
        unusual: share of cameras from far above or below, that roll.
        distances, near_distances: of the person, m; of one who is near.
        near: share of windows in which the person is near and the lower border cuts.
        borders: the lower border of such an image, tangent of the angle below the axis.
        recombined: share of windows with the trunk and the arms of another motion; in half of them
            the arms are of a third one.
        seated: share of windows of people who sit.
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
    near_distances: tuple[float, float] = (0.5, 1.6)
    near: float = 0.2
    borders: tuple[float, float] = (0.3, 0.7)
    recombined: float = 0.4
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


@dataclass(frozen=True, eq=False)
class Figures:
    """Points of people, F frames, in the frames of their parts, m.

    Attributes:
        points: (F, P, 3) of legs and trunk in the frame of the pelvis; of arms from the shoulder,
            in the frame of the chest.
        shoulders: (F, 2, 3) left and right, in the frame of the pelvis.
    """

    points: Floats
    shoulders: Floats


@dataclass(frozen=True, eq=False)
class KeypointTracks:
    """Tracks of landmarks, F frames in all, RATE a second.

    Attributes:
        landmarks: and centres of joints that schemes may have instead.
        joints: of a person of the usual lengths.
        pelvis, chest: (F, 3, 3) turns of the pelvis, and of the chest in the pelvis's frame.
        roots: (F, 3) of the person, m.
        starts, counts: (M,) first frame and number of frames of each track.
        lengths: (M, P) logarithms of the lengths (`lifter.PROPORTIONED`) over the usual ones.
        weights: (M,) share of the windows that are drawn from a track; they sum to 1. Of one that
            is seated 0.
        seated: (M,) whether a track is of legs that sit, with a trunk that is of no use.
        usual: (P,) the usual lengths, m.
    """

    landmarks: Figures
    joints: Figures
    pelvis: Floats
    chest: Floats
    roots: Floats
    starts: Index
    counts: Index
    lengths: Array
    weights: Array
    seated: NDArray[np.bool_]
    usual: Array


def keypoint_tracks(
    body: Body,
    sequences: Sequence[PoseSequence],
    shares: Sequence[float],
    *,
    variants: int = VARIANTS,
    seated: int = SEATED,
    seed: int = 0,
) -> KeypointTracks:
    """Tracks of motions, with variants.

    Args:
        body: with the usual lengths.
        shares: of each motion among the windows, beside the square root of its length.
        variants: number of tracks of each motion; the first is the motion itself.
        seated: number of tracks of people who sit.

    Raises:
        ValueError: no motion is long enough.
    """
    rng = np.random.default_rng(seed)
    usable = [(x, s) for x, s in zip(sequences, shares, strict=True) if len(x.poses) >= SHORTEST]
    if not usable:
        raise ValueError(f'no motion has {SHORTEST} frames')
    parts: list[tuple[Figures, Figures, Array, Array, Array]] = []
    lengths, weights = [], []
    own = body.segment_lengths
    usual = np.array([own[name] for name in PROPORTIONED])

    def add(poses: Array, person: dict[str, float], share: float, plain: bool) -> None:
        of_person = body.with_segment_lengths(person)
        parts.append(_parts(body, of_person, poses, None if plain else rng))
        now = of_person.segment_lengths
        lengths.append(np.log([max(now[x] / own[x], SHORTEST_LENGTH) for x in PROPORTIONED]))
        weights.append(share * np.sqrt(len(poses)))

    for sequence, share in usable:
        for variant in range(variants):
            poses, person = sequence.poses, sequence.lengths
            if variant % 2:
                poses = mirror(body, poses)
            if variant >= PLAIN:
                poses = _varied(body, poses, rng)
            if variant:
                person = _other_lengths(body, person, rng)
            add(poses, person, share, not variant)
    for _ in range(seated):
        add(_seated(body, rng), _other_lengths(body, own, rng), 0.0, False)
    counts = np.array([len(x[2]) for x in parts], dtype=np.intp)
    landmarks, joints = (
        Figures(*(np.concatenate([getattr(x[i], name) for x in parts]) for name in _FIGURE))
        for i in range(2)
    )
    pelvis, chest, roots = (
        np.concatenate([x[i] for x in parts]).astype(np.float32) for i in range(2, 5)
    )
    return KeypointTracks(
        landmarks,
        joints,
        pelvis,
        chest,
        roots,
        np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.intp),
        counts,
        np.array(lengths),
        np.array(weights) / np.sum(weights),
        np.arange(len(counts)) >= len(counts) - seated,
        usual,
    )


_FIGURE = ('points', 'shoulders')


def _parts(
    body: Body, person: Body, poses: Array, rng: np.random.Generator | None
) -> tuple[Figures, Figures, Array, Array, Array]:
    """Landmarks of a person and joints of the usual body in parts, turns and roots of T poses."""
    which = body.skeleton.joint_index(JOINTS)
    frames = forward(person.skeleton, poses)
    turns = frames.rotations()
    pelvis = turns[:, PELVIS]
    chest = pelvis.transpose(0, 2, 1) @ turns[:, CHEST]
    seen = _figure(
        (*LANDMARKS, *CENTRES), _places(person, poses, rng), person, poses, pelvis, chest
    )
    wanted = _figure(JOINTS, body.joint_positions(poses)[:, which], body, poses, pelvis, chest)
    return seen, wanted, pelvis, chest, poses[:, :3] - poses[:, :3].mean(0)


def _figure(
    names: Sequence[str], places: Array, body: Body, poses: Array, pelvis: Array, chest: Array
) -> Figures:
    """Points (T, P, 3) of poses in the frames of their parts."""
    shoulders = body.joint_positions(poses)[:, body.skeleton.joint_index(SHOULDERS)]
    points = (places - poses[:, None, :3]) @ pelvis
    shoulders = (shoulders - poses[:, None, :3]) @ pelvis
    for side, of_side in enumerate(_arms_of(names)):
        points[:, of_side] = (points[:, of_side] - shoulders[:, side, None]) @ chest
    return Figures(points.astype(np.float32), shoulders.astype(np.float32))


def _arms_of(names: Sequence[str]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which points are of the left and of the right arm, below the shoulder."""
    below = ('elbow', 'wrist', 'hand')
    left, right = (
        np.array([x.startswith(side) and x.endswith(below) for x in names])
        for side in ('left', 'right')
    )
    return left, right


def _legs_of(names: Sequence[str]) -> NDArray[np.bool_]:
    """Which points go with the pelvis."""
    lower = ('hip', 'knee', 'ankle', 'heel', 'toe', 'pelvis')
    return np.array([x.endswith(lower) for x in names])


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


def _varied(body: Body, poses: Array, rng: np.random.Generator) -> Array:
    """Poses whose angles wander."""
    size = np.where(body.skeleton.dof_is_rotation, WANDER, 0.0)
    size[3] = 0.0
    size[4:AXES] = LEAN
    size[[name.startswith('trunk') for name in body.dof_names]] = LEAN
    wandering = _wandering(poses.shape, size, rng)
    return np.asarray(np.clip(poses + wandering, body.lower, body.upper))


def _wandering(shape: tuple[int, ...], size: Array, rng: np.random.Generator) -> Array:
    """Angles (T, d) that wander about 0 with standard deviations (d,)."""
    keep = np.exp(-1.0 / (WANDERING * RATE))
    drawn = np.sqrt(1.0 - keep**2) * rng.normal(size=shape)
    drawn[0] /= np.sqrt(1.0 - keep**2)
    return np.asarray(size * lfilter([1.0], [1.0, -keep], drawn, axis=0))


def _seated(body: Body, rng: np.random.Generator) -> Array:
    """Poses of a person who sits and moves the legs a little."""
    middle, size = body.prior_mean.copy(), np.zeros(body.dimension)
    middle[4:AXES] += np.radians(SEATED_LEAN) * rng.normal(size=AXES - 4)
    size[3:AXES] = LEAN
    for i, name in enumerate(body.dof_names):
        if not any(leg in name for leg in LEGS):
            continue
        usual, spread = np.degrees(middle[i]), SEATED_OTHER
        for what, of_joint in (('hip_x', SEATED_HIP), ('knee', SEATED_KNEE)):
            if name.endswith(what):
                usual, spread = of_joint
        middle[i] = np.radians(usual + spread * rng.normal())
        size[i] = 0.5 * np.radians(SEATED_OTHER)
    poses = middle + _wandering((SEATED_FRAMES, body.dimension), size, rng)
    return np.asarray(np.clip(poses, body.lower, body.upper))


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
    which = _drawn_tracks(tracks, n, rng, s)
    now = (_drawn_shares(which, rng) * tracks.counts[which]).astype(np.intp)
    times, there, rows, part = _images(now, tracks.counts[which], rng, s)
    base, first = tracks.starts[which][:, :, None] + rows, tracks.starts[which] + now
    joints = assembled(tracks, tracks.joints, JOINTS, first[..., None])[:, 0]
    # Parts that meet stay those of one motion; hands of people who sit are in their laps.
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
    # The pelvis is about the border.
    across[near, 1] = border[near] + rng.uniform(-0.35, 0.25, near.sum())
    ahead = np.concatenate([across, np.ones((n, 1))], axis=1).astype(f32)
    moves = s.speed * rng.normal(size=(n, 3)) * (rng.random(n) < s.moving)[:, None]
    places += (ahead * distance[:, None])[:, None, None]
    places += (moves[:, None] * times[..., None]).astype(f32)[:, :, None]
    rays = places[..., :2] / np.maximum(places[..., 2:], f32(0.25))
    confidences = there[..., None] * SCHEMES[chosen][:, None].astype(f32)
    if s.noise > 0:
        rays, confidences = with_errors(rays, confidences, distance, times, rng, s.noise, border)
    few = (confidences[:, 0] > 0).sum(1) < FEWEST
    confidences[few, 0] = np.maximum(confidences[few, 0], 0.9 * SCHEMES[chosen[few]])
    up = np.where(rng.random(n)[:, None] < s.gravity, -turn[:, :, 1], 0.0)
    for axis in (0, 2):
        tilt = about(axis, np.radians(s.gravity_spread * rng.normal(size=n)))
        up = np.einsum('nij,nj->ni', tilt, up)
    persons = _proportions(tracks, which)
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


def _drawn_shares(which: Index, rng: np.random.Generator) -> Array:
    """How far tracks (3, N) are over; parts of one track are at one time."""
    result: Array = rng.random(which.shape)
    for part in (1, 2):
        same = which[part] == which[part - 1]
        result[part, same] = result[part - 1, same]
    return result


def assembled(
    tracks: KeypointTracks,
    figures: Figures,
    names: Sequence[str],
    rows: Index,
    part: Floats | None = None,
) -> Floats:
    """Places (N, S, P, 3) of points from rows (3, N, S) of legs, trunk and arms.

    Args:
        part: (3, N, S) share of the frame after each row; None: 0.
    """

    def at(values: Floats, of: int) -> Any:
        if part is None:
            return values[rows[of]]
        share = part[of].reshape(*part[of].shape, *(1,) * (values.ndim - 1))
        return values[rows[of]] * (1 - share) + values[rows[of] + 1] * share

    lower, result = _legs_of(names), at(figures.points, 1)
    result[:, :, lower] = at(figures.points, 0)[:, :, lower]
    shoulders, chest = at(figures.shoulders, 1), at(tracks.chest, 1)
    arms = at(figures.points, 2)
    for side, of_side in enumerate(_arms_of(names)):
        arm = arms[:, :, of_side] @ chest.swapaxes(-1, -2)
        result[:, :, of_side] = shoulders[:, :, side, None] + arm
    result = result @ at(tracks.pelvis, 0).swapaxes(-1, -2)
    return np.asarray(result + at(tracks.roots, 0)[:, :, None])


def meet(joints: Floats) -> NDArray[np.bool_]:
    """Whether arms are within the trunk or a leg, of joints (N, J, 3)."""

    def place(name: str) -> Floats:
        return joints[:, JOINTS.index(name)]

    def distance(point: Floats, one: Floats, other: Floats) -> Floats:
        along = other - one
        share = ((point - one) * along).sum(1) / np.maximum((along * along).sum(1), 1e-9)
        nearest = one + np.clip(share, 0.0, 1.0)[:, None] * along
        return np.asarray(np.linalg.norm(point - nearest, axis=1))

    result = np.zeros(len(joints), dtype=np.bool_)
    for arm in ('left', 'right'):
        for name in ('elbow', 'wrist', 'hand'):
            point = place(f'{arm}_{name}')
            result |= distance(point, place('pelvis'), place('neck')) < TRUNK_RADIUS
            for leg in ('left', 'right'):
                hip, knee, ankle = (place(f'{leg}_{x}') for x in ('hip', 'knee', 'ankle'))
                result |= distance(point, hip, knee) < LEG_RADIUS
                result |= distance(point, knee, ankle) < LEG_RADIUS
    return result


def _proportions(tracks: KeypointTracks, which: Index) -> Array:
    """Proportions (N, P) of people with the legs, trunks and arms of tracks (3, N)."""
    logs = tracks.lengths[which[1]]
    for part, names in ((0, OF_PELVIS), (2, OF_ARM)):
        columns = [PROPORTIONED.index(name) for name in names]
        logs[:, columns] = tracks.lengths[which[part]][:, columns]
    return np.asarray(logs - (logs @ tracks.usual / tracks.usual.sum())[:, None])


# Lengths that go with the legs, and with the arms.
OF_PELVIS = ('thigh', 'shin', 'foot', 'hip_width', 'hip_drop')
OF_ARM = ('upper_arm', 'forearm', 'hand')


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
    """Times of images (N, S), whether there are any, rows of frames, share of the next frame.

    Args:
        now, counts: (3, N) frames now, and numbers of frames, of the tracks of the parts; the
            images end where the first track does, others are played on from their ends.

    Returns:
        Times and whether (N, S), rows and shares (3, N, S).
    """
    n = now.shape[1]
    rate = np.exp(rng.uniform(np.log(s.rates[0]), np.log(s.rates[1]), n))
    rate[rng.random(n) < s.usual_rate] = RATE
    times = np.round(TIMES * rate[:, None]) / rate[:, None]
    there = np.abs(times - TIMES) <= NEAR
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
    border: Array | None = None,
) -> tuple[Floats, Floats]:
    """Rays (N, S, L, 2) and confidences (N, S, L) as a detector would see them.

    Args:
        rays, confidences: as they are; confidence 0: the scheme lacks a landmark, or there is no
            image.
        distance: (N,) of the person, m.
        times: (N, S) of the images, s; the same order in all windows.
        amount: factor on the deviations.
        border: (N,) the lowest y / z in the images; None: they show everything.
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
    beyond = np.zeros_like(factor)
    if border is not None:
        beyond = np.maximum(rays[..., 1] - border[:, None, None], 0.0)
        factor = factor * np.minimum(1.0 + e.beyond * beyond, e.hidden_factor)
    rays = rays + (sigma[:, None, None] * factor)[..., None].astype(f32) * noise
    doubt = 0.75 - 0.12 * factor + 0.15 * normal(n, 1, count) + 0.05 * normal(n, s, count)
    sure = np.where(
        hidden, np.clip(doubt, 0.02, 0.9), np.clip(1 - 0.04 * np.abs(normal(n, s, count)), 0.5, 1)
    )
    sure = np.where(rng.random((n, 1, 1)) < e.unconfident, 1.0, sure)
    sure = np.where(beyond > 0, np.clip(sure - e.doubted * beyond, 0.02, 1.0), sure)
    sure *= ~((beyond > 0) & (rng.random((n, 1, 1)) < 0.5))
    confidences = confidences * sure.astype(f32)
    confidences *= ~(hidden & (rng.random((n, 1, 1)) < 0.3))
    for shape in ((n, 1, count), (n, s, count), (n, s, 1)):
        confidences *= rng.random(shape) > e.missing
    for share, below in zip(e.cut, (BELOW_KNEE, BELOW_HIP), strict=True):
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
