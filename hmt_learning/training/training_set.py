"""Training pairs of silhouettes and poses, from motions seen from all sides (BME 3).

Recorded or procedural motions become poses of one body, and poses that are nearly equal are
dropped. Some are mirrored left to right, some get the arms and trunk of another pose. Each is
turned to a random heading, seen from a random height and distance with a random build, and
drawn as a silhouette with an outline as uneven as that of background subtraction. Most are drawn
in clothes as well, for edges inside the silhouette, and some are cut off at the waist, as by a
table. The same seed gives the same set.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from hmt_learning.motion.motion_file import read_motion
from hmt_learning.motion.procedural_motion import procedural_motion
from hmt_learning.motion.retarget import body_from_motion, retarget
from hmt_learning.rendering.renderer import render
from hmt_learning.rendering.scene import Scene
from hmt_ros.body import Body, Camera
from hmt_ros.body.mirror import mirror, root_angles, root_rotations
from hmt_ros.body.rasterisation import render_silhouettes
from hmt_ros.experts.descriptor.contour import MIN_AREA
from hmt_ros.experts.descriptor.internal_edges import EDGES
from hmt_ros.experts.descriptor.silhouette_descriptor import (
    MIN_POINTS,
    SilhouetteParts,
    silhouette_parts,
)
from hmt_ros.experts.pose_encoding import AXES, PoseEncoding
from hmt_ros.experts.pose_predictor import RATE
from hmt_ros.inference.arrays import Array, Index

Bytes = NDArray[np.uint8]
Item = TypeVar('Item')
Progress = Callable[[Iterable[Item], int], Iterable[Item]]

MOTION_SUFFIXES = ('.bvh', '.amc')
# Orientation of a level camera that looks along the world's y axis.
LEVEL = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
SIDE = 224  # of a training image, px
FILLED = 0.86  # share of the image side that the largest person of a group fills
ROOM = 0.36  # flesh beyond the outermost joints, sum of both ends, m
GROUP = 16  # silhouettes of one person
LEGS = ('hip', 'knee', 'ankle')
# Range of the height of a cut, as a fraction from pelvis to neck; range of the ambient light.
WAIST, NECK, CUT = 'pelvis', 'neck', (-0.15, 0.45)
AMBIENT = (0.4, 0.8)


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training set.

    Attributes:
        samples: Number of pairs.
        novelty: Minimum mean joint distance of a pose from the last kept pose of its motion, m;
            closer poses are dropped.
        mirrored: Share of poses that are mirrored left to right.
        mixed: Share of poses whose trunk, head and arms are those of another pose.
        elevation, elevation_spread: Angle by which the camera looks down, mean and standard
            deviation, degrees; clipped to -20 to 50.
        roll_spread: Standard deviation of the roll of the camera, degrees.
        distances: Minimum and maximum distance of the camera to the person, m.
        length_spread: Relative standard deviation of each segment length.
        width_range: Range of the factor on the thickness of the whole body.
        width_spread: Relative standard deviation of the thickness of each part.
        boundary_noise: Standard deviation of the outline, px at a person height of 200 px.
        dressed: Share of people rendered with clothes; others have no edges in the silhouette.
        cut: Share of silhouettes that are cut off near the waist.
        seed: Seed of all random choices.

    Raises:
        ValueError: a value is out of its range.
    """

    samples: int = 6000
    novelty: float = 0.02
    mirrored: float = 0.5
    mixed: float = 0.3
    elevation: float = 8.0
    elevation_spread: float = 14.0
    roll_spread: float = 3.0
    distances: tuple[float, float] = (1.8, 9.0)
    length_spread: float = 0.08
    width_range: tuple[float, float] = (0.82, 1.4)
    width_spread: float = 0.12
    boundary_noise: float = 1.0
    dressed: float = 0.8
    cut: float = 0.25
    seed: int = 0

    def __post_init__(self) -> None:
        if self.samples < 1:
            raise ValueError(f'samples must be at least 1, saw {self.samples}')
        for name in ('mirrored', 'mixed', 'dressed', 'cut'):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f'{name} is a share from 0 to 1, saw {getattr(self, name)}')


@dataclass(frozen=True, eq=False)
class PoseSequence:
    """A motion as poses of the body of the predictor.

    Attributes:
        name: Name of the motion.
        activity: Activity, such as walk.
        poses: (T, d), RATE poses per second, as a level camera sees them.
        lengths: Segment lengths of the person by name, m.

    Raises:
        ValueError: poses are not finite.
    """

    name: str
    activity: str
    poses: Array
    lengths: dict[str, float]

    def __post_init__(self) -> None:
        bad = np.asarray(~np.isfinite(self.poses).all(axis=1))
        if bad.any():
            raise ValueError(
                f'{self.name}: {int(bad.sum())} of {len(bad)} poses are not finite, the first in '
                f'frame {int(np.argmax(bad))}'
            )


@dataclass(frozen=True, eq=False)
class TrainingSet:
    """Pairs of silhouettes and poses.

    Attributes:
        poses: (N, d) in the frame of the image's camera.
        previous: (N, d) poses of the same person 1 / RATE s earlier.
        packed: (N, SIDE, SIDE / 8) silhouettes, packed bits.
        edges: (N, EDGES) edges inside the silhouettes, see `internal_edges`; NaN if unknown.
        activities: (N,) activity of each pair.
        sequences, frames: (N,) sequence and frame of each pose.
    """

    poses: Array
    previous: Array
    packed: Bytes
    edges: NDArray[np.float16]
    activities: tuple[str, ...]
    sequences: Index
    frames: Index

    def __len__(self) -> int:
        return len(self.poses)

    def mask(self, sample: int) -> Bytes:
        """Silhouette (SIDE, SIDE) of a sample."""
        return np.unpackbits(self.packed[sample], axis=1)

    def parts(self, sample: int, points: int = 100) -> SilhouetteParts:
        """Parts of a sample's descriptor, from `points` points on the outline."""
        found = silhouette_parts(self.mask(sample), points)
        return replace(found, edges=self.edges[sample].astype(np.float64))


def motion_files(folder: Path) -> list[Path]:
    """The motion files in a folder and its subfolders, in a fixed order.

    Raises:
        ValueError: the folder does not exist or contains no motion.
    """
    wanted = ' or '.join(MOTION_SUFFIXES)
    if not folder.is_dir():
        raise ValueError(f'{folder} is no folder: wanted one with motions ({wanted})')
    found = sorted(x for x in folder.rglob('*') if x.suffix.lower() in MOTION_SUFFIXES)
    if not found:
        raise ValueError(f'{folder} has no motion: wanted files {wanted}')
    return found


def recorded_sequence(path: Path, body: Body) -> PoseSequence:
    """The motion in a file as poses of a body.

    Raises:
        ValueError, OSError: the file is no motion, or its skeleton is unknown.
    """
    motion = read_motion(path)
    motion = motion.part(0, None, max(round(motion.fps / RATE), 1))
    own = body_from_motion(motion, body)
    pelvis = motion.joint_positions(['pelvis'])[:, 0]
    centre = 0.5 * (pelvis.min(0) + pelvis.max(0))
    reach = float(np.linalg.norm(pelvis - centre, axis=1).max())
    translation = np.array([0.0, 0.0, reach + 5.0]) - LEVEL @ centre
    poses = retarget(motion, own, (LEVEL, translation))
    return PoseSequence(motion.name, activity_of(path.stem), poses, own.segment_lengths)


def activity_of(stem: str) -> str:
    """The activity in the name of a file: slowwalk in cmu_07_05_slowwalk."""
    words = [x for x in stem.replace('-', '_').split('_') if x]
    named = [x for x in words if sum(c.isalpha() for c in x) > 1 and not x[0].isdigit()]
    return (named[-1].rstrip('0123456789') if named else stem).lower()


def procedural_sequence(
    name: str, body: Body, duration: float = 16.0, seed: int = 0
) -> PoseSequence:
    """A procedural motion as poses of a body; see `procedural_motion`."""
    poses = procedural_motion(name, body, duration, RATE, seed)
    return PoseSequence(f'{name} {seed}', name, poses, body.segment_lengths)


def typical_body(body: Body, sequences: Sequence[PoseSequence]) -> Body:
    """The body with the median segment lengths over all motions."""
    names = list(sequences[0].lengths)
    table = np.array([[sequence.lengths[name] for name in names] for sequence in sequences])
    medians = np.median(table, axis=0).tolist()
    return body.with_segment_lengths(dict(zip(names, medians, strict=True)))


def training_set(
    body: Body,
    sequences: Sequence[PoseSequence],
    settings: TrainingSettings | None = None,
    progress: Progress[Index] | None = None,
    shares: Sequence[float] | None = None,
) -> TrainingSet:
    """Pairs of silhouettes and poses from motions.

    Args:
        body: Body of the poses, with flesh.
        shares: Share of each motion's poses that is used; None uses all.

    Raises:
        ValueError: there are no motions, or the body has no flesh or another root.
    """
    s = settings or TrainingSettings()
    if not sequences:
        raise ValueError('no motions to learn from')
    PoseEncoding(body)  # checks the root
    rng = np.random.default_rng(s.seed)
    pool = [novel_frames(body, sequence.poses, s.novelty) for sequence in sequences]
    if shares is not None:
        # Evenly spaced frames, at least one of each motion.
        pool = [x[:: round(1.0 / max(y, 1e-3))] for x, y in zip(pool, shares, strict=True)]
    which = np.repeat(np.arange(len(pool)), [len(x) for x in pool])
    frames = np.concatenate(pool)
    chosen = _drawn(len(which), s.samples, rng)
    which, frames = which[chosen], frames[chosen]
    poses, previous = _moments(sequences, which, frames)
    poses, previous = _mixed(body, poses, previous, s.mixed, rng)
    swapped = rng.random(len(poses)) < s.mirrored
    poses[swapped] = mirror(body, poses[swapped])
    previous[swapped] = mirror(body, previous[swapped])
    view = _views(len(poses), s, rng)
    # A group has one distance, so that one camera fits all.
    groups = [np.arange(i, min(i + GROUP, len(poses))) for i in range(0, len(poses), GROUP)]
    distances = np.repeat(rng.uniform(*s.distances, len(groups)), GROUP)[: len(poses)]
    poses, previous = _seen(body, poses, previous, view, distances)
    packed = np.empty((len(poses), SIDE, SIDE // 8), np.uint8)
    edges = np.empty((len(poses), EDGES), np.float16)
    for rows in groups if progress is None else progress(groups, len(groups)):
        person = random_build(body, s, rng)
        for row, (mask, grey) in zip(rows, _drawn_people(person, poses[rows], s, rng), strict=True):
            packed[row] = np.packbits(mask, axis=1)
            edges[row] = silhouette_parts(mask, MIN_POINTS, grey).edges
    activities = tuple(sequences[i].activity for i in which.tolist())
    return TrainingSet(poses, previous, packed, edges, activities, which, frames)


def _drawn_people(
    person: Body, poses: Array, s: TrainingSettings, rng: np.random.Generator
) -> Iterator[tuple[Bytes, Bytes | None]]:
    """Masks and grey levels (SIDE, SIDE) of a person at poses (n, d); grey None if bare."""
    camera = _fitting_camera(person, poses)
    dressed = rng.random() < s.dressed
    light = (*rng.normal(size=2).tolist(), 1.0)
    scene = Scene(
        seed=int(rng.integers(2**32)), light=light, ambient=rng.uniform(*AMBIENT), shadow=0.0,
        clutter=0,
    )  # fmt: skip
    waists = person.joint_positions(poses)[:, person.skeleton.joint_index((WAIST, NECK))]
    for pose, (low, high) in zip(poses, camera.project(waists)[..., 1], strict=True):
        if dressed:
            picture = render(person, pose, camera, scene)
            mask, grey = picture.mask, cv2.cvtColor(picture.image, cv2.COLOR_BGR2GRAY)
        else:
            mask, grey = render_silhouettes(person, pose[None], camera)[0], None
        seen = _uneven(mask.view(np.uint8), s.boundary_noise, rng)
        if rng.random() < s.cut and low > high:
            upper = seen.copy()
            upper[max(round(low - rng.uniform(*CUT) * (low - high)), 0) :] = 0
            seen = upper if np.count_nonzero(upper) > MIN_AREA else seen
        yield seen, None if grey is None else np.asarray(grey, np.uint8)


def novel_frames(body: Body, poses: Array, distance: float) -> Index:
    """Indices (n,) of poses (T, d) that differ from the last one kept, ignoring the heading."""
    still = poses.copy()
    still[:, :3] = 0.0
    still[:, 3] = 0.0
    joints = body.joint_positions(still)
    kept = [0]
    for t in range(1, len(poses)):
        away = np.linalg.norm(joints[t] - joints[kept[-1]], axis=1).mean()
        if away >= distance:
            kept.append(t)
    return np.array(kept, dtype=np.intp)


def _drawn(available: int, count: int, rng: np.random.Generator) -> Index:
    """Indices (count,) of samples; none is drawn again before all have been drawn."""
    rounds = -(-count // available)
    order = np.concatenate([rng.permutation(available) for _ in range(rounds)])
    return np.sort(order[:count])


def _moments(sequences: Sequence[PoseSequence], which: Index, frames: Index) -> tuple[Array, Array]:
    """Poses (N, d) and those one step earlier; the first frame of a motion precedes itself."""
    moments = list(zip(which.tolist(), frames.tolist(), strict=True))
    poses = np.stack([sequences[i].poses[t] for i, t in moments])
    previous = np.stack([sequences[i].poses[max(t - 1, 0)] for i, t in moments])
    return poses, previous


def _mixed(
    body: Body, poses: Array, previous: Array, share: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Replaces trunk, head and arms in a share of the poses by those of another pose."""
    names = body.dof_names
    upper = np.array(
        [i >= AXES and not any(leg in name for leg in LEGS) for i, name in enumerate(names)]
    )
    mine = np.flatnonzero(rng.random(len(poses)) < share)
    other = rng.integers(len(poses), size=len(mine))
    changed, before = poses.copy(), previous.copy()
    changed[np.ix_(mine, upper)] = poses[np.ix_(other, upper)]
    before[np.ix_(mine, upper)] = previous[np.ix_(other, upper)]
    return changed, before


def _views(count: int, s: TrainingSettings, rng: np.random.Generator) -> Array:
    """Rotations (N, 3, 3) of the person in front of the camera."""
    heading = rng.uniform(-np.pi, np.pi, count)
    elevation = np.radians(np.clip(rng.normal(s.elevation, s.elevation_spread, count), -20.0, 50.0))
    roll = np.radians(rng.normal(0.0, s.roll_spread, count))
    return about(2, roll) @ about(0, elevation) @ about(1, heading)


def about(axis: int, angle: Array) -> Array:
    """Rotations (N, 3, 3) about an axis of the camera frame."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    result = np.zeros((len(angle), 3, 3))
    result[:, axis, axis] = 1.0
    result[:, i, i] = result[:, j, j] = np.cos(angle)
    result[:, j, i] = np.sin(angle)
    result[:, i, j] = -result[:, j, i]
    return result


def _seen(
    body: Body, poses: Array, previous: Array, view: Array, distances: Array
) -> tuple[Array, Array]:
    """Poses rotated to a view, with the middle of the joints on the optical axis."""
    step = np.einsum('nij,nj->ni', view, previous[:, :3] - poses[:, :3])
    poses, previous = poses.copy(), previous.copy()
    for x in (poses, previous):
        x[:, 3:AXES] = root_angles(body, view @ root_rotations(body, x))
    poses[:, :3] = 0.0
    joints = body.joint_positions(poses)
    poses[:, :3] = -0.5 * (joints.min(1) + joints.max(1))
    poses[:, 2] += distances
    previous[:, :3] = poses[:, :3] + step
    return poses, previous


def random_build(body: Body, s: TrainingSettings, rng: np.random.Generator) -> Body:
    """A body with random lengths and widths, as for the persons of a training set."""
    lengths = {
        name: value * (1.0 + s.length_spread * rng.normal())
        for name, value in body.segment_lengths.items()
    }
    whole = rng.uniform(*s.width_range)
    widths = whole * np.exp(s.width_spread * rng.normal(size=len(body.shapes)))
    growth = body.growth.copy()
    growth[:, :2] += np.log(np.clip(widths, 0.6, 1.8))[:, None]
    return body.with_segment_lengths(lengths).with_growth(growth)


def _fitting_camera(body: Body, poses: Array) -> Camera:
    """A camera whose image shows all persons of a group completely."""
    joints = body.joint_positions(poses)
    reach = np.abs(joints[..., :2]).max(2) + 0.5 * ROOM
    focal = 0.5 * FILLED * SIDE / float((reach / np.maximum(joints[..., 2], 0.3)).max())
    middle = 0.5 * (SIDE - 1)
    return Camera(focal, focal, middle, middle, SIDE, SIDE)


def _uneven(mask: Bytes, deviation: float, rng: np.random.Generator) -> Bytes:
    """The mask with its outline shifted by smooth noise, px at a person height of 200 px."""
    noise = rng.normal(size=mask.shape).astype(np.float32)
    if deviation == 0 or not mask.any():
        return mask
    inside = cv2.distanceTransform(mask, cv2.DIST_L2, 3)
    outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 3)
    smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5), dtype=np.float32)
    smooth *= np.float32(deviation * max(cv2.boundingRect(mask)[2:]) / 200.0 / smooth.std())
    # The outline lies between pixels, half a pixel from either side.
    signed = np.where(mask > 0, inside - 0.5, 0.5 - outside)
    result: Bytes = (signed + smooth > 0).astype(np.uint8)
    return result if result.any() else mask


def seen_from(
    body: Body,
    sequence: PoseSequence,
    heading: float,
    elevation: float = 0.0,
    *,
    frames: slice = slice(None),
    distance: float = 5.0,
    boundary_noise: float = 0.0,
    seed: int = 0,
) -> tuple[Array, Bytes]:
    """Frames of a motion, seen by a camera with a fixed direction.

    Args:
        body: Body of the sequence's poses, with flesh.
        heading: Mean heading of the person: 0 looks at the camera, 90 to the right of the image,
            180 away from the camera, degrees.
        elevation: Angle by which the camera looks down, degrees.
        distance: Distance of the camera, m.
        boundary_noise: Standard deviation of the outline, px at a person height of 200 px.

    Returns:
        Poses (n, d) with the middle of the joints on the optical axis, and silhouettes
        (n, SIDE, SIDE), 1 inside.

    Raises:
        ValueError: there are no frames.
    """
    poses = sequence.poses[frames]
    if len(poses) == 0:
        raise ValueError(f'{sequence.name}: no frames in {frames} of {len(sequence.poses)}')
    x, _, z = root_rotations(body, poses)[:, :, 1].mean(0)
    turn = np.arctan2(z, x) + 0.5 * np.pi - np.radians(heading)
    down = np.full(len(poses), np.radians(elevation))
    view = about(0, down) @ about(1, np.full(len(poses), turn))
    poses, _ = _seen(body, poses, poses, view, np.full(len(poses), distance))
    rng = np.random.default_rng(seed)
    drawn = render_silhouettes(body, poses, _fitting_camera(body, poses))
    return poses, np.stack([_uneven(mask.view(np.uint8), boundary_noise, rng) for mask in drawn])
