"""The skeleton of a BVH or ASF/AMC file: segments, channels and tips, in file units.

Each segment starts at a joint of the same name, sits at an offset in its parent's frame, and is
turned by its channels; a tip is a named point at the end of a segment without children.
`rig_body` turns this into a `Body` with lengths in metres, whose joints have the standard names of
a human body where the file's names are known.

Programs name joints differently: CMU's ASF (`lfemur`), its BVH conversions by cgspeed (`LeftUpLeg`,
or `lThigh` for Daz), Character Creator (`CC_Base_L_Thigh`), MotionBuilder, Mixamo and the capture
suits (`mixamorig:LeftUpLeg`, `LeftHip`), game rigs (`thigh_l`). A joint is named after the segment
that starts at it, so `LeftUpLeg`, the thigh, is the left hip.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.limb_angles import ARM, LEG, SIDES
from hmt_ros.body.model_file import joint_errors_of, length_covariance, load_body
from hmt_ros.body.skeleton import Skeleton
from hmt_ros.inference.arrays import Array
from msg_tools.files.bounded_file import read_bytes

MAX_FILE_BYTES = 500_000_000  # bytes
MAX_MOTION = 30_000_000  # numbers, frames times channels
_MAX_TEXT, _LINE = 700_000_000, 64  # text in memory, and overhead of a line, bytes
MAX_SEGMENTS = 2_000

# Limits if the file sets none, as for the root of a human body: ten turns, rad; a large hall, m.
FREE_ANGLE = 20 * np.pi
FREE_SHIFT = 1_000.0
SKULL_AND_HEEL = 0.12  # above the head joint and below the ankle, relative to the bones in between
NARROWEST = 1e-6  # margin added to limits of a file that leave no range, rad

# Names in lower case without separators, sides and prefixes; the first one in the file is used.
CENTRAL = {
    'pelvis': ('hips', 'hip', 'pelvis', 'root'),
    'neck': ('lowerneck', 'neck', 'necktwist01', 'neck01', 'neck1', 'necklower'),
    'head': ('head',),
}
PAIRED = {
    'hip': ('femur', 'upleg', 'thigh', 'upperleg', 'thighbend', 'hip'),
    'knee': ('tibia', 'leg', 'lowleg', 'lowerleg', 'shin', 'calf', 'knee'),
    'ankle': ('foot', 'ankle'),
    'toe': ('toes', 'toebase', 'toe', 'ball'),
    'shoulder': ('humerus', 'arm', 'upperarm', 'uparm', 'shldr', 'shldrbend', 'shoulder'),
    'elbow': ('radius', 'forearm', 'lowerarm', 'lowarm', 'forearmbend', 'elbow'),
    'wrist': ('wrist', 'hand'),
    'hand': ('fingerbase', 'hand', 'handend', 'mid1', 'middle1', 'handmiddle1', 'fingers'),
}
TIPPED = {'toe': 'ankle', 'hand': 'wrist'}  # otherwise any child of that joint
PREFIX = re.compile(r'^(cc_base_|bip0*1[ _]?|def[-_]|mixamorig\d*[:_]?|character\d+_)', re.I)


class MotionFileError(ValueError):
    """Unreadable motion file; one line names file, line, what was seen and what was wanted."""

    def __init__(self, path: Path, line: int | None, message: str) -> None:
        super().__init__(f'{path}: {message}' if line is None else f'{path}:{line}: {message}')


@dataclass(frozen=True)
class Channel:
    """One number per frame: shift along or turn about axis 0 to 2; limits in rad or file units."""

    axis: int
    is_rotation: bool
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True, eq=False)
class RigJoint:
    """A named point: the start of a segment, or the tip of a segment without children.

    Attributes:
        name: name in the file.
        parent: index of the segment that carries it; -1 for the root.
        offset: (3,) in that segment's frame, file units.
        length_name: name of the length that scales the offset; siblings may share one.
    """

    name: str
    parent: int
    offset: Array
    length_name: str


@dataclass(frozen=True, eq=False)
class RigSegment(RigJoint):
    """A segment of a file's skeleton, and the joint of the same name at its start.

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
        """Starts of the segments, then tips; parent indices are valid for joints, too."""
        return (*self.segments, *self.tips)

    @property
    def is_rotation(self) -> NDArray[np.bool_]:
        """(d,) whether each channel is a rotation."""
        return np.array([c.is_rotation for s in self.segments for c in s.channels], dtype=bool)

    def standard_names(self) -> list[str]:
        """Names of the joints, standard ones if the skeleton is a human's."""
        return standard_names([x.name for x in self.joints], [x.parent for x in self.joints])


def read_text(path: Path) -> str:
    """Text of a motion file.

    Raises:
        FileNotFoundError: the file does not exist.
        MotionFileError: the file is larger than a motion file can be, or not text.
    """
    if not path.is_file():
        raise FileNotFoundError(f'no motion file {path}')
    try:
        content = read_bytes(path, MAX_FILE_BYTES)
    except ValueError as error:
        raise MotionFileError(path, None, str(error)) from error
    # All characters at which Python splits lines.
    lines = sum(content.count(x) for x in b'\n\r\v\f\x1c\x1d\x1e\x85')
    if 2 * len(content) + _LINE * lines > _MAX_TEXT:
        raise MotionFileError(path, None, f'{lines} lines in {len(content)} bytes are too many')
    if b'\0' in content:
        line = content.count(b'\n', 0, content.index(b'\0')) + 1
        raise MotionFileError(path, line, 'binary data, wanted the text of a motion file')
    try:
        return content.decode('utf-8-sig')
    except UnicodeDecodeError:  # joint names in a national encoding
        return content.decode('latin-1')


def numbers(path: Path, line: int, words: Sequence[str], count: int, what: str) -> Array:
    """`count` finite numbers from the words of a line.

    Raises:
        MotionFileError: the count differs, or a word is not a finite number.
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
    """Body of a rig, without flesh and pose prior; one length per bone, m."""
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
        rates=_rates(rig, names),
        length_covariance=length_covariance(values, np.full(len(values), 0.05)),
        stature_lengths=tuple(upright),
        stature_extra=SKULL_AND_HEEL * sum(lengths[k] for k in upright),
        default_lengths=values,
        symmetries=load_body('human37').symmetries,
        joint_errors=joint_errors_of(names),
    )


def _rates(rig: Rig, names: Sequence[str]) -> Array:
    """Variances (d,) per second, from human37; segments unknown there take their parent's."""
    person = load_body('human37')
    known = person.skeleton
    turns = {
        int(s): float(rate)
        for s, rate, turn in zip(known.dof_segments, person.rates, known.dof_is_rotation)
        if turn
    }
    by_joint = {
        joint: turns[int(s)]
        for joint, s, offset in zip(known.joint_names, known.joint_segments, known.joint_offsets)
        if not np.any(offset)
    }
    trunk = turns[known.segment_names.index('trunk')]
    own: list[float] = []
    result = []
    for segment, name in zip(rig.segments, names):
        above = turns[0] if segment.parent < 0 else trunk if segment.parent == 0 else None
        own.append(by_joint.get(name, own[segment.parent] if above is None else above))
        result += [own[-1] if c.is_rotation else float(person.rates[0]) for c in segment.channels]
    return np.array(result)


def _unique(names: Sequence[str]) -> list[str]:
    """The names, with underscores appended to those that occurred before."""
    result: dict[str, None] = {}
    for name in names:
        while name in result:
            name += '_'
        result[name] = None
    return list(result)


def _upright_bones(rig: Rig, names: Sequence[str]) -> list[str]:
    """Names of the lengths from left ankle to head via the pelvis; empty for other rigs."""
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
    """Name as in the package's models (root_tx, root_z), or from the file's segment (LeftLeg_x)."""
    owner = 'root' if rig.segments[segment].parent < 0 else rig.segments[segment].name
    return f'{owner}_{"" if channel.is_rotation else "t"}{"xyz"[channel.axis]}'


def _chains(rig: Rig, names: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Limbs of a human rig: segments from the first joint to the last, from the trunk outwards."""
    ends = {'neck': ('neck', 'head')}
    for side in SIDES:
        ends[f'{side}_arm'] = (f'{side}_{ARM[0]}', f'{side}_{ARM[-2]}')
        ends[f'{side}_leg'] = (f'{side}_{LEG[0]}', f'{side}_{LEG[-2]}')
    chains = {}
    parents = [joint.parent for joint in rig.joints]
    for chain, (first, last) in ends.items():
        known = first in names and last in names
        if known and _leads_to(parents, names.index(first), names.index(last)):
            path = [names.index(last)]
            while names[path[-1]] != first:
                path.append(rig.joints[path[-1]].parent)
            chains[chain] = tuple(s for s in reversed(path) if s < len(rig.segments))
    return chains


def standard_names(names: Sequence[str], parents: Sequence[int]) -> list[str]:
    """Names of a file's joints; standard ones (`left_hip`) if the skeleton is a human's.

    A human's skeleton has pelvis, neck, head and all hips, knees, ankles, shoulders, elbows and
    wrists, each behind the previous joint of its limb.

    Args:
        names: (J,) names of the joints in the file.
        parents: (J,) index of each joint's parent, -1 for the root.
    """
    found = _matches(names, parents)
    if found is None:
        return list(names)
    by_joint = {joint: standard for standard, joint in found.items()}
    result = []
    for joint, name in enumerate(names):
        own = by_joint.get(joint, name)
        if joint not in by_joint and own in found:  # a standard name used for another joint
            own += '_'
        result.append(own)
    return result


def _matches(names: Sequence[str], parents: Sequence[int]) -> dict[str, int] | None:
    known: dict[str, int] = {}
    for joint, name in enumerate(names):
        known.setdefault(_plain(name), joint)
    used: set[int] = set()
    found: dict[str, int] = {}
    for standard, variants in _spellings():
        candidates = [known[v] for v in variants if v in known]
        side, _, kind = standard.partition('_')
        if kind in TIPPED:
            carrier = found.get(f'{side}_{TIPPED[kind]}')
            candidates += [j for j, p in enumerate(parents) if p == carrier]
        for joint in candidates:
            if joint not in used:
                found[standard] = joint
                used.add(joint)
                break
    for way in _ways():
        needed = [name for name in way if name.partition('_')[2] not in TIPPED]
        if not all(name in found for name in needed):
            return None
        present = [found[name] for name in way if name in found]
        if not all(_leads_to(parents, a, b) for a, b in pairwise(present)):
            return None
    return found


def _plain(name: str) -> str:
    name = PREFIX.sub('', name.rpartition(':')[2])
    return re.sub(r'[^a-z0-9]', '', name.lower())


def _spellings() -> Iterator[tuple[str, list[str]]]:
    for standard, variants in CENTRAL.items():
        yield standard, list(variants)
    for standard, variants in PAIRED.items():
        for side in SIDES:
            marks = (side, side[0])
            spelt = [f'{m}{v}' for v in variants for m in marks]
            yield f'{side}_{standard}', spelt + [f'{v}{m}' for v in variants for m in marks]


def _ways() -> Iterator[list[str]]:
    yield ['pelvis', 'neck', 'head']
    for side in SIDES:
        for limb in (ARM, LEG):
            yield ['pelvis', *(f'{side}_{joint}' for joint in limb)]


def _leads_to(parents: Sequence[int], start: int, end: int) -> bool:
    while end >= 0 and end != start:
        end = parents[end]
    return end == start
