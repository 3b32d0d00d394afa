"""export: writes the motion of a recorded run into a file for other programs.

export out -o walk.bvh
"""

from __future__ import annotations

import argparse
import csv
import io
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from hmt_ros.app.command_line import CommandParser, number, run_command, whole_number
from hmt_ros.app.progress import say, show_progress
from hmt_ros.app.recorded_bodies import RecordedBodies, read_grounds
from hmt_ros.body import Body
from hmt_ros.body.moving_skeleton import CAMERA_TO_ROOM, MovingSkeleton, bvh_text
from hmt_ros.inference.arrays import Array
from msg_tools import BagReader
from msg_tools.files.new_folder import check_file_place, new_file
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.pose_mixtures import (
    POSE_MIXTURE,
    MixtureKind,
    PoseMixture,
    pose_mixture_of,
)

FORMATS = ('.bvh', '.csv', '.npz')
# Radius of the 90 % region of a 3D Gaussian, in units of its largest standard deviation.
RADIUS_90 = 2.5003
# Minimum length of a gap between poses, in median intervals.
_GAP_RATIO = 1.5
# Rotation of the vertical above which the camera is not static, degrees.
_MAX_CAMERA_TURN = 5.0

EPILOG = """\
The suffix of OUT selects the format.
  .bvh  joints and their angles at even times, m, for Blender and other programs
  .csv  a row for each stamp: joint positions and their 90 % radii, m
  .npz  arrays: poses, joint positions, covariances, weights, lengths

A BVH is upright, with y up and the floor at y = 0, if the bag has gravity and floor; otherwise it
has the axes of the mixtures, x right, turned from y down and z forward to y up and z back. Tables
and arrays are in the frame of the mixtures.

Without --identity each pose is the heaviest mode at its time, which may jump from one motion to
another; with it all poses belong to one motion, for as long as that motion lasts.

examples:
  export out -o walk.bvh
  export out -o walk.bvh --topic pose_mixture --track 2
  export out -o walk.npz --identity 9

exit code: 0 done, 1 bad input (one line on stderr explains it)
"""


@dataclass(frozen=True, eq=False)
class TrackedPose:
    """One component of a mixture over poses, see `PoseMixture`."""

    stamp_ns: int
    track_id: int
    identity: int
    weight: float
    pose: Array
    covariance: Array | None
    joints: Array
    joint_covariances: Array | None
    segment_lengths: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class TrackedMotion:
    """The motion of one track on one topic: one pose at each of T times.

    Attributes:
        topic: topic of the mixtures.
        steps: (T,) poses in the order of their stamps.
        of: the last mixture; its fields that are equal in all mixtures are used.
        body: body with the segment lengths of the last mixture; None if unknown.
        room: (3, 3) rotation from the frame of the mixtures to a frame with y up.
        height: height of the camera above the floor, m; 0 if unknown.
        notes: lines of text for the user.
    """

    topic: str
    steps: Sequence[TrackedPose]
    of: PoseMixture
    body: Body | None
    room: Array
    height: float
    notes: Sequence[str]

    @property
    def times(self) -> Array:
        """Times (T,) since the first pose, s."""
        return np.array([step.stamp_ns - self.steps[0].stamp_ns for step in self.steps]) / SECOND_NS

    @property
    def rate(self) -> float:
        """Median number of poses per second; 30 for a single pose."""
        return 30.0 if len(self.steps) == 1 else float(1.0 / np.median(np.diff(self.times)))

    def skeleton(self) -> MovingSkeleton:
        """The motion as a skeleton with the segment lengths of the last pose.

        Raises:
            ValueError: the body is unknown, or several of its segments have translations.
        """
        if self.body is None:
            raise ValueError(
                f'{self.topic}: the body {self.of.body_model!r} is not known: name its model '
                'with --body, or write .csv or .npz, which need none'
            )
        poses = np.array([step.pose for step in self.steps])
        return MovingSkeleton.of_body(self.body, poses, self.times, self.room, self.height)


def main(argv: list[str] | None = None) -> int:
    """Runs the command; returns 0 on success, 1 for bad input (explained in one line on stderr)."""
    return run_command(_parser(), _export, argv, whole_or_nothing=True)


def _parser() -> CommandParser:
    parser = CommandParser('export', 'Writes the motion of a recorded run into a file.', EPILOG)
    parser.add_argument(
        'bag', type=Path, metavar='RUN', help='bag with mixtures: a folder or a file'
    )
    parser.add_output('OUT', 'file', f'file to write, one of {" ".join(FORMATS)}')
    parser.add_argument(
        '--topic',
        metavar='NAME',
        help='mixtures over poses (default: smoothed, else the posterior, else predictions)',
    )
    parser.add_argument(
        '--identity',
        type=whole_number(1),
        metavar='N',
        help='export the motion with this identity (default: the heaviest mode at each time)',
    )
    parser.add_argument(
        '--track', type=whole_number(0), metavar='N', help='track_id (default: the longest track)'
    )
    parser.add_argument(
        '--fps',
        type=number(0.01, 1e4),
        metavar='RATE',
        help='frame rate of a .bvh, 1/s (default: as recorded)',
    )
    parser.add_argument(
        '--camera-axes',
        action='store_true',
        help='do not turn the motion upright even if gravity is known',
    )
    parser.add_argument(
        '--body',
        metavar='MODEL',
        help='body model of the poses: a name or a YAML file (default: the model that RUN names)',
    )
    return parser


def _export(arguments: argparse.Namespace) -> int:
    output, quiet = arguments.output, arguments.quiet
    kind = output.suffix.lower()
    if kind not in FORMATS:
        raise ValueError(f'{output} ends in {kind!r}, wanted one of {" ".join(FORMATS)}')
    if arguments.fps is not None and kind != '.bvh':
        raise ValueError(f'--fps is for .bvh: a {kind} has the stamps of the recording')
    check_file_place(output, overwrite=arguments.overwrite)
    with show_progress(str(output), 'messages', quiet=quiet) as bar:
        motion = read_tracked_motion(
            arguments.bag,
            arguments.topic,
            arguments.identity,
            arguments.track,
            body_model=arguments.body,
            camera_axes=arguments.camera_axes,
            progress=bar.update,
        )
        content = motion_bytes(motion, kind, arguments.fps)
        with new_file(output) as file:
            file.write(content)
    if not quiet:
        span = f'{len(motion.steps)} poses over {motion.times[-1]:.2f} s'
        rate = f' at {arguments.fps or motion.rate:.4g} a second' if kind == '.bvh' else ''
        notes = (f'  {note}' for note in motion.notes)
        say(f'{output}: {span}{rate}, of {motion.topic}', *notes)
    return 0


def motion_bytes(motion: TrackedMotion, kind: str, rate: float | None = None) -> bytes:
    """Returns the content of the file to write.

    Args:
        kind: one of `FORMATS`.
        rate: poses per second of a .bvh; None selects the median rate of the motion.

    Raises:
        ValueError: the body is unknown, which a .bvh needs, or there are too many poses.
    """
    if kind == '.csv':
        return _table(motion).encode('utf-8')
    if kind == '.npz':
        file = io.BytesIO()
        np.savez_compressed(file, **_arrays(motion))
        return file.getvalue()
    rate = motion.rate if rate is None else rate
    return bvh_text(motion.skeleton().at_rate(rate), rate).encode('utf-8')


def _table(motion: TrackedMotion) -> str:
    """Text of a .csv file, one row per time; radii are left out if covariances are unknown."""
    covariances = _all([step.joint_covariances for step in motion.steps])
    columns = ['x', 'y', 'z']
    numbers = np.array([step.joints for step in motion.steps])
    if covariances is not None:
        columns.append('radius_90')
        largest = np.linalg.eigvalsh(covariances)[..., -1:]
        numbers = np.concatenate([numbers, RADIUS_90 * np.sqrt(largest.clip(0.0))], axis=-1)
    file = io.StringIO()
    table = csv.writer(file, lineterminator='\n')
    joints = [f'{name}_{column}' for name in motion.of.joint_names for column in columns]
    table.writerow(['stamp', 'weight', *joints])
    for step, row in zip(motion.steps, numbers, strict=True):
        seconds, rest = divmod(step.stamp_ns, SECOND_NS)
        cells = [f'{x:.5f}' for x in (step.weight, *row.reshape(-1))]
        table.writerow([f'{seconds}.{rest:09d}', *cells])
    return file.getvalue()


def _arrays(motion: TrackedMotion) -> dict[str, Any]:
    """Arrays for a .npz file by name; covariances are left out if unknown."""
    steps, of = motion.steps, motion.of
    names = list(of.segment_lengths)
    result = {
        'stamps': np.array([step.stamp_ns for step in steps], dtype=np.int64),
        'weights': np.array([step.weight for step in steps]),
        'identities': np.array([step.identity for step in steps]),
        'poses': np.array([step.pose for step in steps]),
        'covariances': _all([step.covariance for step in steps]),
        'dof_names': np.array(of.dof_names),
        'joints': np.array([step.joints for step in steps]),
        'joint_covariances': _all([step.joint_covariances for step in steps]),
        'joint_names': np.array(of.joint_names),
        'segment_lengths': np.array(
            [[step.segment_lengths.get(name, np.nan) for name in names] for step in steps]
        ),
        'segment_names': np.array(names, dtype=np.str_),
        'track_id': steps[0].track_id,
        'frame_id': of.frame_id,
        'body_model': of.body_model,
        'room_from_frame': motion.room,
        'camera_height': motion.height,
    }
    return {name: value for name, value in result.items() if value is not None}


def _all(values: Sequence[Array | None]) -> Array | None:
    """Stacks values into one array; None if a value is unknown."""
    return None if any(value is None for value in values) else np.array(values)


def read_tracked_motion(
    path: Path,
    topic: str | None = None,
    identity: int | None = None,
    track: int | None = None,
    *,
    body_model: str | None = None,
    camera_axes: bool = False,
    progress: Callable[[int], object] = lambda count: None,
) -> TrackedMotion:
    """Reads the motion of a recorded run; the first pose of each stamp is used.

    Args:
        topic: topic of mixtures over poses; None selects smoothed mixtures, else the posterior,
            else predictions.
        identity: identity of the motion; None selects the heaviest mode at each time.
        track: number of the track; None selects the track with the most poses.
        body_model: name or file of the body model, which replaces the name in the bag.
        camera_axes: whether to keep the axes of the camera even if gravity is known.

    Raises:
        ValueError: no such topic, track or motion, or invalid messages.
    """
    bodies = RecordedBodies(body_model)
    steps: dict[int, dict[int, TrackedPose]] = {}
    last: dict[int, PoseMixture] = {}
    motions: dict[int, Counter[int]] = {}
    end = 0
    with BagReader(path) as bag:
        name = _topic(bag, topic)
        for content in _mixtures(bag, name, bodies, progress):
            end = max(end, content.stamp_ns)
            if not len(content.weights):
                continue
            own = content.track_id
            assert content.identities is not None
            motions.setdefault(own, Counter()).update(content.identities.tolist())
            step = _pose(content, identity)
            if step is not None:
                steps.setdefault(own, {}).setdefault(step.stamp_ns, step)
                last[own] = content
    chosen = _track(f'{path}: {name}', steps, motions, track, identity)
    ordered = [steps[chosen][stamp] for stamp in sorted(steps[chosen])]
    of = last[chosen]
    room, height, told = CAMERA_TO_ROOM, 0.0, 'in the axes of the camera'
    if not camera_axes:
        room, height, told = _room(path, name, of.frame_id)
    what = 'heaviest modes' if identity is None else f'motion {identity}'
    whose = f' of track {chosen}' if chosen else ''
    notes = [f'{what}{whose}, {told}', *_notes(ordered, end)]
    if len(steps) > 1:
        others = ', '.join(f'{key} ({len(steps[key])} poses)' for key in sorted(steps))
        notes.append(f'there are several tracks, {others}: --track chooses one')
    return TrackedMotion(name, ordered, of, bodies.of(name, of), room, height, notes)


def _topic(bag: BagReader, wanted: str | None) -> str:
    """Name of the topic to read."""
    if wanted is not None:
        return bag.find_topic([POSE_MIXTURE], wanted).name
    kinds: dict[int, list[str]] = {}
    for each in bag.topics_of(POSE_MIXTURE):
        first = next(bag.messages([each.name])).message
        kinds.setdefault(int(first.kind), []).append(each.name)
    named = ', '.join(name for names in kinds.values() for name in names)
    for kind in (MixtureKind.SMOOTHED, MixtureKind.POSTERIOR, MixtureKind.PREDICTION):
        if len(kinds.get(kind, [])) > 1:
            raise ValueError(f'{bag.path} has several motions: --topic one of {named}')
        if kind in kinds:
            return kinds[kind][0]
    tracked = any(topic.msgtype == POSE_MIXTURE for topic in bag.topics.values())
    nothing = 'nobody is found in its images' if tracked else 'it has no mixtures over poses'
    raise ValueError(
        f'{bag.path} has no smoothed poses, no posterior and no predictions: '
        + (f'--topic one of {named}' if named else nothing)
    )


def _mixtures(
    bag: BagReader, name: str, bodies: RecordedBodies, progress: Callable[[int], object]
) -> Iterator[PoseMixture]:
    """Yields the mixtures on a topic, which must agree in degrees of freedom and joints."""
    names: dict[str, tuple[str, ...]] = {}
    for stored in bodies.messages(bag, [name], progress):
        content = stored.content(partial(pose_mixture_of, **names))
        names = {'dof_names': content.dof_names, 'joint_names': content.joint_names}
        yield content


def _pose(content: PoseMixture, identity: int | None) -> TrackedPose | None:
    """The heaviest component, optionally with a given identity; None if missing."""
    assert content.identities is not None
    weights = content.weights
    if identity is not None:
        weights = np.where(content.identities == identity, weights, -1.0)
    k = int(np.argmax(weights))
    if weights[k] < 0.0:
        return None
    covariances, spread = content.covariances, content.joint_covariances
    return TrackedPose(
        content.stamp_ns,
        content.track_id,
        int(content.identities[k]),
        float(weights[k]),
        content.means[k],
        None if covariances is None else covariances[k],
        content.joint_positions[k],
        None if spread is None else spread[k],
        content.segment_lengths,
    )


def _track(
    where: str,
    steps: Mapping[int, Mapping[int, TrackedPose]],
    motions: Mapping[int, Counter[int]],
    track: int | None,
    identity: int | None,
) -> int:
    """Number of the wanted track, by default of the longest track."""
    if not motions:
        raise ValueError(f'{where}: nobody is seen in any mixture')
    if track is not None and track not in motions:
        raise ValueError(f'{where} has no track {track}; it has {sorted(motions)}')
    known = {key: own for key, own in steps.items() if track in (None, key)}
    if not known:
        every = sum((motions[key] for key in motions if track in (None, key)), Counter[int]())
        listed = ', '.join(str(key) for key, _ in every.most_common(8) if key)
        raise ValueError(
            f'{where} has no motion of identity {identity}; '
            + (f'the longest are {listed}' if listed else 'its modes have no identities')
        )
    return max(known, key=lambda key: len(known[key]))


def _room(path: Path, topic: str, frame_id: str) -> tuple[Array, float, str]:
    """Rotation to a frame with y up, camera height, m (0 if unknown), and text about the frame."""
    grounds = read_grounds(path, topic, frame_id).values()
    if not grounds:
        told = f'in the axes of {frame_id}, turned to y up: its gravity is not known'
        return CAMERA_TO_ROOM, 0.0, told
    ups = np.array([ground.up for ground in grounds])
    up = ups.mean(axis=0) / np.linalg.norm(ups.mean(axis=0))
    # z is opposite to the horizontal part of the viewing direction; if the camera looks straight
    # down, z points to the bottom of the image.
    back = np.array([0.0, 0.0, -1.0]) if abs(up[2]) < 0.99 else np.array([0.0, 1.0, 0.0])
    back -= (back @ up) * up
    back /= np.linalg.norm(back)
    heights = [ground.height for ground in grounds if ground.height is not None]
    told = 'upright, the floor at y = 0' if heights else 'upright, the camera at y = 0'
    turned = float(np.degrees(np.arccos(np.clip(ups @ up, -1.0, 1.0).min())))
    if turned > _MAX_CAMERA_TURN:
        told += f'; the camera moved: gravity turned by up to {turned:.0f} degrees from its mean'
    height = float(np.median(heights)) if heights else 0.0
    return np.stack([np.cross(up, back), up, back]), height, told


def _notes(steps: Sequence[TrackedPose], end: int) -> list[str]:
    """Notes for the user about a motion; `end` is the last stamp on its topic, ns."""
    notes = []
    others = np.array([a.identity != b.identity for a, b in pairwise(steps)], dtype=bool)
    if others.any():
        moved = [np.linalg.norm(b.joints - a.joints, axis=-1).max() for a, b in pairwise(steps)]
        most, usual = (max(np.array(moved)[x], default=0.0) for x in (others, ~others))
        notes.append(
            f'changes from one motion to another: {others.sum()}; a joint moves by up to '
            f'{most:.2f} m then, and by {usual:.2f} m between other poses'
        )
    gaps = np.diff([step.stamp_ns for step in steps]) / SECOND_NS
    long = gaps[gaps > _GAP_RATIO * np.median(gaps)] if len(gaps) else gaps
    if len(long):
        notes.append(f'gaps: {len(long)}, the longest {long.max():.2f} s; skeletons move on')
    if steps[-1].stamp_ns < end:
        notes.append(
            f'it ends {(end - steps[-1].stamp_ns) / SECOND_NS:.2f} s before the topic does'
        )
    lengths = [step.segment_lengths for step in steps]
    pairs = [(x, lengths[-1].get(name, x)) for own in lengths for name, x in own.items()]
    change = max((abs(a - b) for a, b in pairs), default=0.0)
    if change > 5e-4:
        notes.append(
            f'lengths of segments change by up to {1e3 * change:.0f} mm: skeletons have the last '
            'ones'
        )
    return notes
