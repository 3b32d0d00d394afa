"""The skeleton of a motion file before it is a body: segments, channels and tips, in file units.

What BVH and ASF/AMC share. Each segment starts at a joint of the same name, sits at an offset in
its parent's frame, and is turned by its channels; a tip is a named point at the far end of a
segment that carries no other. `rig_body` turns this into a `Body` with lengths in metres, whose
joints bear the standard names of a human body where the file's names are known (`rig_names.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.motion.rig_names import ARM, LEG, SIDES, standard_names
from msg_tools.files.bounded_file import read_bytes

Array = NDArray[np.float64]

LARGEST_FILE = 500_000_000  # bytes
LARGEST_MOTION = 100_000_000  # numbers, frames times channels
MOST_SEGMENTS = 2_000

# Where the file sets no limits, those of the root of a human body: ten turns, and a large hall.
FREE_ANGLE = 20 * np.pi
FREE_SHIFT = 1_000.0
SKULL_AND_HEEL = 0.12  # above the head joint and below the ankle, over the bones between them
NARROWEST = 1e-6  # a limit of a file may leave no room; a body's must, rad


class MotionFileError(ValueError):
    """A motion file that can not be read; one line with file, line, what was seen and wanted."""

    def __init__(self, path: Path, line: int | None, message: str) -> None:
        super().__init__(f'{path}: {message}' if line is None else f'{path}:{line}: {message}')


@dataclass(frozen=True)
class Channel:
    """One number a frame: shift along or turn about axis 0 to 2; limits in rad or file units."""

    axis: int
    is_rotation: bool
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True, eq=False)
class RigJoint:
    """A named point: the start of a segment, or the tip of one that carries no other.

    Attributes:
        name: in the file.
        parent: index of the segment that carries it, -1: the root.
        offset: (3,) in that segment's frame, file units.
        length_name: the length that the offset runs along; siblings may share one.
    """

    name: str
    parent: int
    offset: Array
    length_name: str


@dataclass(frozen=True, eq=False)
class RigSegment(RigJoint):
    """A segment of a file's skeleton, and the joint of the same name that it starts at.

    Attributes:
        channels: translations first, then rotations in the order in which they act.
        mount: (3, 3) rotation from its frame to its parent's, at zero angles.
    """

    channels: tuple[Channel, ...]
    mount: Array


@dataclass(frozen=True, eq=False)
class Rig:
    """A file's skeleton: segments (parents before children) and tips."""

    segments: tuple[RigSegment, ...]
    tips: tuple[RigJoint, ...]

    @property
    def joints(self) -> tuple[RigJoint, ...]:
        """Starts of the segments, then tips; a joint's parent is also the index of a joint."""
        return (*self.segments, *self.tips)

    @property
    def is_rotation(self) -> NDArray[np.bool_]:
        """(d,) kind of each channel."""
        return np.array([c.is_rotation for s in self.segments for c in s.channels], dtype=bool)

    def standard_names(self) -> list[str]:
        """Names of the joints, the standard ones where the skeleton is a human's."""
        return standard_names([x.name for x in self.joints], [x.parent for x in self.joints])


def read_text(path: Path) -> str:
    """Text of a motion file.

    Raises:
        FileNotFoundError: no such file.
        MotionFileError: larger than a motion file can sensibly be, or not text.
    """
    if not path.is_file():
        raise FileNotFoundError(f'no motion file {path}')
    try:
        content = read_bytes(path, LARGEST_FILE)
    except ValueError as error:
        raise MotionFileError(path, None, str(error)) from error
    if b'\0' in content:
        line = content.count(b'\n', 0, content.index(b'\0')) + 1
        raise MotionFileError(path, line, 'binary data, wanted the text of a motion file')
    try:
        return content.decode('utf-8-sig')
    except UnicodeDecodeError:  # names of joints in some national encoding
        return content.decode('latin-1')


def numbers(path: Path, line: int, words: Sequence[str], count: int, what: str) -> Array:
    """`count` finite numbers from the words of a line.

    Raises:
        MotionFileError: another count, or a word that is not a finite number.
    """
    try:
        values = np.array([float(word) for word in words])
    except ValueError:
        values = np.array([np.nan])
    if len(words) != count or not np.isfinite(values).all():
        seen = ' '.join(words)[:60]
        raise MotionFileError(path, line, f'{what}: saw {seen!r}, wanted {count} finite numbers')
    return values


def rig_body(rig: Rig, name: str, unit_to_m: float) -> Body:
    """Body of a rig without flesh and without beliefs; one length a bone, in metres."""
    names = _unique(rig.standard_names())
    bones = [(x.length_name, x.offset * unit_to_m) for x in rig.joints]
    lengths: dict[str, float] = {}
    for bone, offset in bones:
        span = float(np.linalg.norm(offset))
        if span > 0:
            lengths.setdefault(bone, span)
    length_names = list(lengths)
    basis = np.zeros((len(bones), 3, len(lengths)))
    for row, (bone, offset) in enumerate(bones):
        if np.any(offset):
            basis[row, :, length_names.index(bone)] = offset / lengths[bone]
    s_count = len(rig.segments)
    channels = [(s, c) for s, segment in enumerate(rig.segments) for c in segment.channels]
    lower, upper = _limits([c for _, c in channels], unit_to_m)
    values = np.array(list(lengths.values()))
    skeleton = Skeleton(
        name=name,
        segment_names=tuple(s.name for s in rig.segments),
        parents=tuple(s.parent for s in rig.segments),
        mounts=np.array([s.mount for s in rig.segments]),
        fixed_offsets=np.zeros((s_count, 3)),
        offset_basis=basis[:s_count],
        dof_names=tuple(_unique([_dof_name(rig, s, c) for s, c in channels])),
        dof_segments=np.array([s for s, _ in channels], dtype=np.intp),
        dof_axes=np.array([c.axis for _, c in channels], dtype=np.intp),
        dof_is_rotation=np.array([c.is_rotation for _, c in channels], dtype=bool),
        lower=lower,
        upper=upper,
        joint_names=tuple(names),
        joint_segments=np.array([*range(s_count), *(t.parent for t in rig.tips)], dtype=np.intp),
        joint_fixed=np.zeros((len(bones), 3)),
        joint_basis=np.concatenate([np.zeros_like(basis[:s_count]), basis[s_count:]]),
        length_names=tuple(length_names),
        lengths=values,
        chains=_chains(rig, names),
    )
    upright = [k for k in _upright_bones(rig, names) if k in lengths]
    return Body(
        skeleton=skeleton,
        shapes=(),
        prior_mean=np.zeros(len(channels)),
        prior_sigma=np.full(len(channels), np.inf),
        length_sigma=0.05 * values,
        stature_lengths=tuple(upright),
        stature_extra=SKULL_AND_HEEL * sum(lengths[k] for k in upright),
        default_lengths=values,
    )


def _unique(names: Sequence[str]) -> list[str]:
    """The names, with an underscore behind those that stand before."""
    result: dict[str, None] = {}
    for name in names:
        while name in result:
            name += '_'
        result[name] = None
    return list(result)


def _upright_bones(rig: Rig, names: Sequence[str]) -> list[str]:
    """Lengths from left ankle to head by way of the pelvis; none if it is not a human's."""
    if not {'left_ankle', 'head', 'pelvis'} <= set(names):
        return []
    result = []
    for end in ('left_ankle', 'head'):
        joint = names.index(end)
        while joint >= 0 and names[joint] != 'pelvis':
            result.append(rig.joints[joint].length_name)
            joint = rig.joints[joint].parent
    return list(dict.fromkeys(result))


def _limits(channels: Sequence[Channel], unit_to_m: float) -> tuple[Array, Array]:
    rotation = np.array([c.is_rotation for c in channels], dtype=bool)
    widest = np.where(rotation, FREE_ANGLE, FREE_SHIFT)
    scale = np.where(rotation, 1.0, unit_to_m)
    lower = np.maximum(scale * np.array([c.lower for c in channels]), -widest)
    upper = np.minimum(scale * np.array([c.upper for c in channels]), widest)
    tight = upper - lower < NARROWEST
    return lower - NARROWEST * tight, upper + NARROWEST * tight


def _dof_name(rig: Rig, segment: int, channel: Channel) -> str:
    """As in the models that ship: root_tx, root_z, then LeftLeg_x after the file's own name."""
    owner = 'root' if rig.segments[segment].parent < 0 else rig.segments[segment].name
    return f'{owner}_{"" if channel.is_rotation else "t"}{"xyz"[channel.axis]}'


def _chains(rig: Rig, names: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Limbs of a human rig: segments from the first joint to the last, from the trunk outwards."""
    ends = {'neck': ('neck', 'head')}
    for side in SIDES:
        ends[f'{side}_arm'] = (f'{side}_{ARM[0]}', f'{side}_{ARM[-2]}')
        ends[f'{side}_leg'] = (f'{side}_{LEG[0]}', f'{side}_{LEG[-2]}')
    chains = {}
    for chain, (first, last) in ends.items():
        if first in names and last in names:
            path = [names.index(last)]
            while names[path[-1]] != first:
                path.append(rig.joints[path[-1]].parent)
            chains[chain] = tuple(s for s in reversed(path) if s < len(rig.segments))
    return chains
