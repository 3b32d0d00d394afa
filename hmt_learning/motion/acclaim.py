"""ASF and AMC, the skeleton and motion files of Acclaim, as CMU's motion capture library has them.

A bone runs from its parent's end along a direction given in the frame of the root. With C the
rotation of its `axis` and M that of its angles, applied in the order of the letters of `axis`,

    rotation of the bone = its parent's * C M C^-1,    end = start + rotation * direction * length

so in the frame rotation * C the angles are plain Euler angles, and C^-1(parent) C is the mount.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hmt_learning.motion.rig import (
    MAX_MOTION,
    MAX_SEGMENTS,
    Channel,
    MotionFileError,
    Rig,
    RigJoint,
    RigSegment,
    numbers,
)
from hmt_ros.inference.arrays import Array

INCH = 0.0254  # m; with CMU's `length 0.45` a file unit is 1 / 0.45 inch
CHANNELS = {
    f'{kind}{letter}': (axis, kind == 'r') for kind in 'tr' for axis, letter in enumerate('xyz')
}
BONE_KEYS = (
    'id',
    'name',
    'direction',
    'length',
    'axis',
    'dof',
    'limits',
    'bodymass',
    'cofmass',
    'end',
)


@dataclass(frozen=True, eq=False)
class Acclaim:
    """The content of an ASF.

    Attributes:
        rig: the skeleton, angles in rad.
        unit_to_m: metres per unit of length.
        degrees: whether angles are in degrees if the AMC does not declare a unit.
        columns: by bone, the channel indices in the rig of the numbers on its AMC line.
        dimension: number of channels.
    """

    rig: Rig
    unit_to_m: float
    degrees: bool
    columns: dict[str, list[int]]
    dimension: int


@dataclass(eq=False)
class _Bone:
    line: int
    name: str = ''
    direction: Array | None = None
    length: float | None = None
    axis: Array | None = None
    order: str = 'xyz'
    dofs: list[str] = field(default_factory=list)
    limits: list[tuple[float, float]] = field(default_factory=list)
    position: Array = field(default_factory=lambda: np.zeros(3))
    parent: str = ''


def read_asf(path: Path, text: str) -> Acclaim:
    """Skeleton of an ASF.

    Raises:
        MotionFileError: the text is not a complete ASF.
    """
    sections = _sections(path, text)
    units = dict(_units(path, sections.get('units', [])))
    bones = {'root': _root(path, sections['root'])}
    for bone in _bones(path, sections['bonedata']):
        if bone.name in bones:
            raise MotionFileError(path, bone.line, f'a second bone {bone.name!r}, wanted one')
        bones[bone.name] = bone
    order = _hierarchy(path, sections['hierarchy'], bones)
    degrees = units.get('angle', 1.0) > 0
    return _acclaim(bones, order, units.get('length', 1.0), degrees)


def read_amc(path: Path, text: str, skeleton: Acclaim) -> Array:
    """Channels (T, d) in the rig's order, rad and file units.

    Raises:
        MotionFileError: a bone is unknown or missing, or has a wrong number of values.
    """
    degrees = skeleton.degrees
    lines = text.splitlines()
    at = 0
    for at, line in enumerate(lines):  # noqa: B007
        words = line.split('#')[0].split()
        if not words:
            continue
        if not words[0].startswith(':'):
            break
        if words[0].upper() in {':DEGREES', ':RADIANS'}:
            degrees = words[0].upper() == ':DEGREES'
    else:
        raise MotionFileError(path, len(lines), 'the file ends, wanted frames')
    values = _frames(path, lines, at, skeleton)
    return values * np.where(skeleton.rig.is_rotation, np.pi / 180 if degrees else 1.0, 1.0)


def _frames(path: Path, lines: Sequence[str], at: int, skeleton: Acclaim) -> Array:
    """Values (T, d) of all frames, starting at line `at`."""
    frames: list[Array] = []
    missing: set[str] = set()
    first_frame = 0
    for i in range(at, len(lines)):
        words = lines[i].split('#')[0].split()
        if not words:
            continue
        if len(words) == 1 and words[0].isdecimal():
            if missing:
                raise MotionFileError(path, i + 1, f'the frame before lacks {_some(missing)}')
            first_frame = int(words[0]) if not frames else first_frame
            wanted = first_frame + len(frames)
            if int(words[0]) != wanted:
                raise MotionFileError(path, i + 1, f'frame {words[0][:20]}, wanted frame {wanted}')
            missing = set(skeleton.columns)
            frames.append(np.zeros(skeleton.dimension))
            if len(frames) * skeleton.dimension > MAX_MOTION:
                raise MotionFileError(path, i + 1, f'more than {MAX_MOTION} numbers')
            continue
        if not frames:
            raise MotionFileError(path, i + 1, f'saw {lines[i].strip()[:60]!r}, wanted frame 1')
        bone = words[0]
        if bone not in missing:
            fault = 'twice in one frame' if bone in skeleton.columns else 'not in the skeleton'
            raise MotionFileError(path, i + 1, f'bone {bone[:40]!r} is {fault}')
        missing.discard(bone)
        columns = skeleton.columns[bone]
        frames[-1][columns] = numbers(path, i + 1, words[1:], len(columns), f'bone {bone}')
    if missing or not frames:
        seen = f'the last frame lacks {_some(missing)}' if frames else 'no frame'
        raise MotionFileError(path, len(lines), f'the file ends, {seen}')
    return np.array(frames)


def _some(names: set[str]) -> str:
    return ', '.join(sorted(names)[:3]) + (' and more' if len(names) > 3 else '')


Lines = list[tuple[int, list[str]]]


def _sections(path: Path, text: str) -> dict[str, Lines]:
    """Numbered lines of each `:keyword` section, split into words, without comments."""
    result: dict[str, Lines] = {}
    current: Lines | None = None
    number = 0
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split('#')[0].replace('(', ' ').replace(')', ' ').split()
        if not words:
            continue
        if words[0].startswith(':'):
            current = result.setdefault(words[0][1:].lower(), [])
        elif current is None:
            raise MotionFileError(path, number, f'saw {line[:40]!r}, wanted :version')
        else:
            current.append((number, words))
    for name in ('root', 'bonedata', 'hierarchy'):
        if name not in result:
            raise MotionFileError(path, number, f'the file ends, wanted :{name}')
    return result


def _units(path: Path, lines: Lines) -> Iterator[tuple[str, float]]:
    for line, words in lines:
        key = words[0].lower()
        if key == 'angle':
            if words[1:] not in (['deg'], ['rad']):
                seen = ' '.join(words)[:40]
                raise MotionFileError(path, line, f'saw {seen!r}, wanted angle deg or angle rad')
            yield key, 1.0 if words[1] == 'deg' else -1.0
        elif key == 'length':
            value = float(numbers(path, line, words[1:], 1, key)[0])
            if value <= 0:
                raise MotionFileError(path, line, f'length unit {value:g}, wanted more than 0')
            yield key, value


def _root(path: Path, lines: Lines) -> _Bone:
    root = _Bone(lines[0][0] if lines else 0, name='root', direction=np.zeros(3), length=0.0)
    root.axis = np.zeros(3)
    root.dofs = ['tx', 'ty', 'tz', 'rx', 'ry', 'rz']
    for line, words in lines:
        key, rest = words[0].lower(), words[1:]
        if key == 'order':
            root.dofs = _dofs(path, line, rest)
        elif key == 'axis':
            root.order = _order(path, line, rest)
        elif key == 'position':
            root.position = numbers(path, line, rest, 3, key)
        elif key == 'orientation':
            root.axis = numbers(path, line, rest, 3, key)
        else:
            raise MotionFileError(
                path, line, f'saw {words[0]!r}, wanted order, axis, position or orientation'
            )
    return root


def _bones(path: Path, lines: Lines) -> Iterator[_Bone]:
    bone: _Bone | None = None
    last = ''
    count = 0
    for line, words in lines:
        key, rest = words[0].lower(), words[1:]
        if key == 'begin':
            if bone is not None:
                raise MotionFileError(path, line, f'begin inside of the bone of line {bone.line}')
            bone, count = _Bone(line), count + 1
            if count > MAX_SEGMENTS:
                raise MotionFileError(path, line, f'more than {MAX_SEGMENTS} bones')
        elif bone is None:
            raise MotionFileError(path, line, f'saw {" ".join(words)[:60]!r}, wanted begin')
        elif key == 'end':
            yield _complete(path, bone)
            bone = None
        elif key == 'limits' or (last == 'limits' and key not in BONE_KEYS):
            low, high = _limit(path, line, rest if key == 'limits' else words)
            bone.limits.append((low, high))
            key = 'limits'
        elif key == 'name' and len(rest) == 1:
            bone.name = rest[0]
        elif key == 'direction':
            bone.direction = numbers(path, line, rest, 3, key)
        elif key == 'length':
            bone.length = float(numbers(path, line, rest, 1, key)[0])
        elif key == 'axis':
            bone.axis = numbers(path, line, rest[:3], 3, key)
            bone.order = _order(path, line, rest[3:])
        elif key == 'dof':
            bone.dofs = _dofs(path, line, rest)
            if any(dof[0] == 't' for dof in bone.dofs):
                seen = ' '.join(rest)
                raise MotionFileError(path, line, f'{bone.name}: saw {seen}, wanted rx, ry, rz')
        elif key not in BONE_KEYS:
            raise MotionFileError(path, line, f'saw {words[0]!r}, wanted {", ".join(BONE_KEYS)}')
        last = key
    if bone is not None:
        raise MotionFileError(path, bone.line, 'a bone without end')


def _complete(path: Path, bone: _Bone) -> _Bone:
    for key in ('name', 'direction', 'length', 'axis'):
        if getattr(bone, key) is None or (key == 'name' and not bone.name):
            raise MotionFileError(path, bone.line, f'bone {bone.name or "?"} has no {key}')
    if bone.limits and len(bone.limits) != len(bone.dofs):
        raise MotionFileError(
            path,
            bone.line,
            f'bone {bone.name}: {len(bone.limits)} limits for {len(bone.dofs)} degrees of freedom',
        )
    return bone


def _limit(path: Path, line: int, words: Sequence[str]) -> tuple[float, float]:
    try:
        low, high = (float(word) for word in words)
    except ValueError:
        low, high = np.nan, np.nan
    if not low <= high:
        seen = ' '.join(words)[:40]
        raise MotionFileError(path, line, f'saw limits {seen!r}, wanted two numbers, lower first')
    return low, high


def _dofs(path: Path, line: int, words: Sequence[str]) -> list[str]:
    dofs = [word.lower() for word in words]
    if len(set(dofs)) != len(dofs) or not set(dofs) <= set(CHANNELS):
        seen, wanted = ' '.join(words)[:60], ' '.join(CHANNELS)
        raise MotionFileError(
            path, line, f'saw channels {seen!r}, wanted some of {wanted}, each once'
        )
    return dofs


def _order(path: Path, line: int, words: Sequence[str]) -> str:
    order = ''.join(words).lower()
    if sorted(order) != ['x', 'y', 'z']:
        raise MotionFileError(path, line, f'saw {" ".join(words)[:40]!r}, wanted an order like XYZ')
    return order


def _hierarchy(path: Path, lines: Lines, bones: dict[str, _Bone]) -> list[str]:
    """Sets the parents, and returns the bone names with parents before children."""
    order = {'root': 0}
    for line, words in lines:
        if words in (['begin'], ['end']):
            continue
        unknown = [word for word in words if word not in bones]
        if unknown:
            raise MotionFileError(path, line, f'unknown bone {unknown[0][:40]!r} in the hierarchy')
        if words[0] not in order:
            raise MotionFileError(path, line, f'{words[0]} has children before it has a parent')
        for name in words[1:]:
            if name in order:
                raise MotionFileError(path, line, f'{name} has a parent already')
            bones[name].parent = words[0]
            order[name] = len(order)
    lost = [name for name in bones if name not in order]
    if lost:
        raise MotionFileError(path, bones[lost[0]].line, f'bone {lost[0]} is not in the hierarchy')
    return list(order)


def _acclaim(bones: dict[str, _Bone], order: list[str], length: float, degrees: bool) -> Acclaim:
    unit = np.pi / 180 if degrees else 1.0
    segments: list[RigSegment] = []
    tips: list[RigJoint] = []
    columns: dict[str, list[int]] = {}
    axes: dict[str, Array] = {}
    dimension = 0
    for name in order:
        bone = bones[name]
        assert bone.axis is not None
        axes[name] = _rotation(bone.order, unit * bone.axis)
        if bone.parent:
            parent = order.index(bone.parent)
            before = axes[bone.parent].T
            offset, mount = before @ _span(bones[bone.parent]), before @ axes[name]
        else:
            parent, offset, mount = -1, bone.position, axes[name]
        # In a product of rotations, the one that is applied first is the last factor.
        ranks = {'t': -3, **{letter: -i for i, letter in enumerate(bone.order)}}
        acting = sorted(bone.dofs, key=lambda dof: ranks['t' if dof[0] == 't' else dof[1]])
        channels = []
        for dof in acting:
            low, high = bone.limits[bone.dofs.index(dof)] if bone.limits else (-np.inf, np.inf)
            channels.append(Channel(*CHANNELS[dof], low * unit, high * unit))
        if bone.dofs:
            columns[name] = [dimension + acting.index(dof) for dof in bone.dofs]
        dimension += len(bone.dofs)
        length_name = bone.parent or 'root_position'
        segments.append(RigSegment(name, parent, offset, length_name, tuple(channels), mount))
        if not any(other.parent == name for other in bones.values()):
            end = axes[name].T @ _span(bone)
            tips.append(RigJoint(f'{name}_end', len(segments) - 1, end, name))
    return Acclaim(Rig(tuple(segments), tuple(tips)), INCH / length, degrees, columns, dimension)


def _span(bone: _Bone) -> Array:
    assert bone.direction is not None
    assert bone.length is not None
    return bone.direction * bone.length


def _rotation(order: str, angles: Array) -> Array:
    """Rotation about the fixed axes x, y, z, applied in the order of the letters."""
    result = np.eye(3)
    for letter in order:
        axis = 'xyz'.index(letter)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[i, i] = turn[j, j] = np.cos(angles[axis])
        turn[j, i] = np.sin(angles[axis])
        turn[i, j] = -turn[j, i]
        result = turn @ result
    return result
