"""Landmark trajectories of moving people, and people assembled from several of them.

Each recorded motion gives several tracks: as recorded, mirrored, with other proportions, and with
wandering angles. Tracks of seated people are synthetic.

    p_legs = r + R l        p_trunk = r + R t        p_arm = r + R (s + C a)

r, R are position and rotation of the pelvis; l, t, s positions of legs, trunk and shoulder in its
frame; C is the rotation of the chest in that frame, a the position of an arm relative to its
shoulder in the chest's frame. Legs with r and R, trunk with s and C, and arms may come from three
different tracks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from hmt_learning.training.training_set import LEGS, PoseSequence
from hmt_ros.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import mirror
from hmt_ros.experts.lifter import (
    LANDMARKS,
    PROPORTION_LENGTHS,
    SUBSTITUTES,
    landmark_offsets,
    log_ratios,
    relative,
)
from hmt_ros.experts.pose_encoding import AXES
from hmt_ros.experts.pose_predictor import RATE
from hmt_ros.image.keypoint_schemes import landmarks
from hmt_ros.inference.arrays import Array, Index

Floats = NDArray[np.float32]

# Joints of the poses to be learned.
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
# Joint centres, for keypoint schemes that use them; a track has them after the skin landmarks.
CENTRES = tuple(name for name in SUBSTITUTES if name != 'centre_of_neck')
SHOULDERS = ('left_shoulder', 'right_shoulder')
# Lengths taken from the track of the legs, and from that of the arms.
OF_PELVIS = ('thigh', 'shin', 'foot', 'hip_width', 'hip_drop')
OF_ARM = ('upper_arm', 'forearm', 'hand')

# Number of tracks per motion, and how many of them have no wandering angles.
VARIANTS, PLAIN = 4, 2
# Indices of the segments of pelvis and chest.
PELVIS, CHEST = 0, 1
# Number of seated tracks and of their frames; mean and standard deviation of the angles of hips and
# knees; standard deviations of the pelvis's lean and of other leg angles, degrees.
SEATED, SEATED_FRAMES = 48, 240
SEATED_HIP, SEATED_KNEE, SEATED_LEAN, SEATED_OTHER = (85.0, 12.0), (-88.0, 22.0), 9.0, 8.0
# Radius of trunk and leg, within which a joint of an arm counts as inside, m.
TRUNK_RADIUS, LEG_RADIUS = 0.10, 0.07
# Minimum standard deviation of a landmark over people, clothes and detectors, m.
MIN_SIGMA = 0.022
# Factor on the spread of lengths over people, for variants; minimum share of a length that remains.
OF_SPREAD, MIN_LENGTH = 0.8, 0.4
# Wandering angles: standard deviations of joints, and of root and trunk; correlation time, s.
WANDER, LEAN, WANDERING = np.radians(7.0), np.radians(4.0), 2.0
MIN_FRAMES = 10  # minimum number of frames of a motion


@dataclass(frozen=True, eq=False)
class Figures:
    """Points of people in F frames, in the coordinates of their body parts, m.

    Attributes:
        points: (F, P, 3) legs and trunk in the frame of the pelvis; arms relative to the shoulder,
            in the frame of the chest.
        shoulders: (F, 2, 3) left and right, in the frame of the pelvis.
    """

    points: Floats
    shoulders: Floats


@dataclass(frozen=True, eq=False)
class KeypointTracks:
    """Tracks of landmarks, F frames in total, RATE per second.

    Attributes:
        landmarks: landmarks of the tracked persons, then the joint centres of some schemes.
        joints: joints of a person of the usual lengths in the same poses.
        pelvis, chest: (F, 3, 3) rotations of the pelvis, and of the chest in the pelvis's frame.
        roots: (F, 3) root positions relative to their mean over the track, m.
        starts, counts: (M,) first frame and number of frames of each track.
        lengths: (M, P) log ratios of the lengths (`lifter.PROPORTION_LENGTHS`) to the usual ones.
        weights: (M,) share of the windows that are drawn from each track; 0 for seated tracks.
        seated: (M,) whether a track is of a seated person; only its legs are used.
        usual: body with the usual lengths.
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
    usual: Body


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
        body: body with the usual lengths.
        shares: factor on each motion's share of the windows, the square root of its length.
        variants: number of tracks of each motion; the first is the motion itself.
        seated: number of tracks of people who sit.

    Raises:
        ValueError: no motion is long enough.
    """
    rng = np.random.default_rng(seed)
    usable = [(x, s) for x, s in zip(sequences, shares, strict=True) if len(x.poses) >= MIN_FRAMES]
    if not usable:
        raise ValueError(f'no motion has {MIN_FRAMES} frames')
    parts: list[tuple[Figures, Figures, Array, Array, Array]] = []
    lengths, weights = [], []
    own = body.segment_lengths

    def add(poses: Array, person: dict[str, float], share: float, plain: bool) -> None:
        of_person = body.with_segment_lengths(person)
        parts.append(_parts(body, of_person, poses, None if plain else rng))
        lengths.append(log_ratios(body, of_person.segment_lengths))
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
    of_parts = [*zip(*parts, strict=True)]
    landmarks, joints = (
        Figures(*map(np.concatenate, zip(*((x.points, x.shoulders) for x in each), strict=True)))
        for each in of_parts[:2]
    )
    pelvis, chest, roots = (np.concatenate(each).astype(np.float32) for each in of_parts[2:])
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
        body,
    )


def _parts(
    body: Body, person: Body, poses: Array, rng: np.random.Generator | None
) -> tuple[Figures, Figures, Array, Array, Array]:
    """Landmarks of a person, joints of the usual body, rotations and roots of T poses."""
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
    """Points (T, P, 3) of poses in the coordinates of their body parts."""
    shoulders = body.joint_positions(poses)[:, body.skeleton.joint_index(SHOULDERS)]
    points = (places - poses[:, None, :3]) @ pelvis
    shoulders = (shoulders - poses[:, None, :3]) @ pelvis
    for side, of_side in enumerate(_arms_of(names)):
        points[:, of_side] = (points[:, of_side] - shoulders[:, side, None]) @ chest
    return Figures(points.astype(np.float32), shoulders.astype(np.float32))


def _arms_of(names: Sequence[str]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the points of the left and of the right arm, without the shoulder."""
    below = ('elbow', 'wrist', 'hand')
    left, right = (
        np.array([x.startswith(side) and x.endswith(below) for x in names])
        for side in ('left', 'right')
    )
    return left, right


def _legs_of(names: Sequence[str]) -> NDArray[np.bool_]:
    """Mask of the points of legs and pelvis."""
    lower = ('hip', 'knee', 'ankle', 'heel', 'toe', 'pelvis')
    return np.array([x.endswith(lower) for x in names])


def _other_lengths(
    body: Body, lengths: dict[str, float], rng: np.random.Generator
) -> dict[str, float]:
    """Lengths of a person of other proportions, drawn with the body's length covariance."""
    names = body.skeleton.length_names
    factor = np.linalg.cholesky(body.length_covariance + 1e-12 * np.eye(len(names)))
    other = OF_SPREAD * factor @ rng.normal(size=len(names))
    return {
        name: max(lengths[name] + more, MIN_LENGTH * lengths[name])
        for name, more in zip(names, other.tolist(), strict=True)
    }


def _varied(body: Body, poses: Array, rng: np.random.Generator) -> Array:
    """Poses with slowly varying noise on the angles."""
    size = np.where(body.skeleton.dof_is_rotation, WANDER, 0.0)
    size[3] = 0.0
    size[4:AXES] = LEAN
    size[[name.startswith('trunk') for name in body.dof_names]] = LEAN
    wandering = _wandering(poses.shape, size, rng)
    return np.asarray(np.clip(poses + wandering, body.lower, body.upper))


def _wandering(shape: tuple[int, ...], size: Array, rng: np.random.Generator) -> Array:
    """Autoregressive noise (T, d) of mean 0 with standard deviations (d,)."""
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
    """Landmarks and centres (T, L + C, 3) of a person; rng, if given, draws their offsets."""
    names = (*LANDMARKS, *CENTRES)
    joints, offsets = landmark_offsets(body, names)
    if rng is not None:
        sigma = np.array([max(landmarks()[name].sigma, MIN_SIGMA) for name in names])
        offsets = offsets + sigma[:, None] * rng.normal(size=offsets.shape)
    skeleton = body.skeleton
    which = skeleton.joint_index(tuple(joints))
    points = forward(skeleton, poses).points(
        skeleton.joint_segments[which], skeleton.joint_offsets[which] + offsets
    )
    return np.asarray(points.transpose(2, 0, 1))


def assembled(
    tracks: KeypointTracks,
    figures: Figures,
    names: Sequence[str],
    rows: Index,
    part: Floats | None = None,
) -> Floats:
    """Point positions (N, S, P, 3) from frames (3, N, S) of legs, trunk and arms.

    Args:
        part: (3, N, S) interpolation weight of the next frame; None stands for 0.
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
    """Whether an arm is inside the trunk or a leg, for joints (N, J, 3)."""

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


def proportions_of(tracks: KeypointTracks, which: Index) -> Array:
    """Proportions (N, P) of people with the legs, trunks and arms of tracks (3, N)."""
    logs = tracks.lengths[which[1]]
    for part, names in ((0, OF_PELVIS), (2, OF_ARM)):
        columns = [PROPORTION_LENGTHS.index(name) for name in names]
        logs[:, columns] = tracks.lengths[which[part]][:, columns]
    return relative(tracks.usual, logs)
