"""BVH, the motion file of Biovision: a hierarchy of joints, and one line of numbers per frame.

    position of a joint = its parent's frame * (OFFSET + position channels)
    rotation of a joint = its parent's rotation * Rot(first channel) * Rot(second) * ...

In some programs position channels replace OFFSET, in others they add to it. This is decided for
each joint: if their median reaches more than half of OFFSET, they replace it.
"""

from __future__ import annotations

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

_MAX_WORDS = 20_000  # maximum number of words in a line, because parsing time is quadratic
_MAX_NAME = 200  # characters
CHANNELS = {
    f'{letter}{kind}': (axis, kind == 'rotation')
    for kind in ('position', 'rotation')
    for axis, letter in enumerate('xyz')
}


def read_bvh(path: Path, text: str) -> tuple[Rig, Array, float]:
    """Skeleton, channels (T, d) in the rig's order, degrees and file units, and frame time, s.

    Raises:
        MotionFileError: the text is not a complete BVH.
    """
    lines = text.splitlines()
    joints, at = _hierarchy(path, lines)
    count = sum(len(joint.channels) for joint in joints)
    values, frame_time = _motion(path, lines, at, count)
    return (*_rig(path, joints, values), frame_time)


@dataclass(eq=False)
class _Joint:
    """A joint of the file; a tip (End Site) has no channels."""

    name: str
    parent: int
    line: int
    is_tip: bool
    offset: Array | None = None
    channels: list[tuple[int, bool]] = field(default_factory=list)


def _hierarchy(path: Path, lines: list[str]) -> tuple[list[_Joint], int]:
    """Joints in the order of the file, and the index of the line after MOTION."""
    joints: list[_Joint] = []
    stack: list[int] = []
    pending: _Joint | None = None
    started = False
    for i, line in enumerate(lines):
        words = line.replace('{', ' { ').replace('}', ' } ').split()
        if len(words) > _MAX_WORDS:
            raise MotionFileError(path, i + 1, f'{len(words)} words in a line')
        while words:
            word, key = words[0], words[0].upper()
            if not started:
                if key != 'HIERARCHY':
                    raise MotionFileError(path, i + 1, f'saw {line[:40]!r}, wanted HIERARCHY')
                started, words = True, words[1:]
            elif key in {'ROOT', 'JOINT', 'END'} and pending is None:
                pending = _opened(path, i + 1, words, joints, stack)
                words = words[words.index('{') :] if '{' in words else []
            elif word == '{' and pending is not None:
                stack.append(len(joints))
                joints.append(pending)
                pending, words = None, words[1:]
            elif word == '}' and stack and pending is None:
                _closed(path, i + 1, joints[stack.pop()])
                words = words[1:]
            elif key == 'OFFSET' and stack and pending is None:
                joints[stack[-1]].offset = numbers(path, i + 1, words[1:4], 3, 'OFFSET')
                words = words[4:]
            elif key == 'CHANNELS' and stack and pending is None:
                words = _channels(path, i + 1, words, joints[stack[-1]])
            elif key == 'MOTION' and joints and not stack and pending is None:
                return joints, i + 1
            else:
                wanted = '{' if pending else 'ROOT, JOINT, End Site, OFFSET, CHANNELS, } or MOTION'
                raise MotionFileError(path, i + 1, f'saw {line.strip()[:60]!r}, wanted {wanted}')
    wanted = 'MOTION' if started and not stack else 'a closing }' if started else 'HIERARCHY'
    raise MotionFileError(path, len(lines), f'the file ends, wanted {wanted}')


def _opened(
    path: Path, line: int, words: list[str], joints: list[_Joint], stack: list[int]
) -> _Joint:
    key = words[0].upper()
    name = ' '.join(words[1 : words.index('{') if '{' in words else None])
    if (key == 'ROOT') != (not joints) or (key != 'ROOT' and not stack):
        raise MotionFileError(
            path, line, f'saw {" ".join(words)!r}, wanted one ROOT and its JOINTs'
        )
    if stack and joints[stack[-1]].is_tip:
        raise MotionFileError(path, line, f'saw {" ".join(words)!r} inside of an End Site')
    if len(joints) >= MAX_SEGMENTS:
        raise MotionFileError(path, line, f'more than {MAX_SEGMENTS} joints')
    parent = stack[-1] if stack else -1
    if key == 'END':
        return _Joint(f'{joints[parent].name}_end', parent, line, True)
    if not 0 < len(name) <= _MAX_NAME:
        raise MotionFileError(path, line, f'saw {words[0]} with a name of {len(name)} characters')
    return _Joint(name, parent, line, False)


def _closed(path: Path, line: int, joint: _Joint) -> None:
    if joint.offset is None:
        raise MotionFileError(path, line, f'{joint.name} (line {joint.line}) has no OFFSET')


def _channels(path: Path, line: int, words: list[str], joint: _Joint) -> list[str]:
    """Reads CHANNELS n name ... and returns the words after it."""
    count = int(words[1]) if len(words) > 1 and words[1].isdecimal() else -1
    named = words[2 : 2 + max(count, 0)]
    if joint.is_tip or joint.channels:
        raise MotionFileError(path, line, f'{joint.name}: CHANNELS a second time or at an End Site')
    if count < 0 or len(named) != count:
        raise MotionFileError(
            path, line, f'saw {" ".join(words)!r}, wanted CHANNELS, their number, and as many names'
        )
    for name in named:
        channel = CHANNELS.get(name.lower())
        if channel is None or channel in joint.channels:
            fault = 'unknown channel' if channel is None else 'twice the channel'
            wanted = 'Xposition to Zrotation, each once'
            raise MotionFileError(path, line, f'{joint.name}: {fault} {name!r}, wanted {wanted}')
        joint.channels.append(channel)
    return words[2 + count :]


def _motion(path: Path, lines: list[str], at: int, count: int) -> tuple[Array, float]:
    """Values (T, count) in the file's order and frame time, s, from the line after MOTION."""
    header: list[tuple[int, str]] = []
    while at < len(lines) and len(header) < 2:
        if lines[at].strip():
            header.append((at + 1, lines[at]))
        at += 1
    frames, frame_time = 0, 0.0
    for (line, seen), key in zip(header, ('Frames:', 'Frame Time:')):
        label, _, value = seen.partition(':')
        if ' '.join(label.lower().split()) != key.lower()[:-1]:
            raise MotionFileError(path, line, f'saw {seen.strip()[:60]!r}, wanted {key}')
        number = float(numbers(path, line, value.split(), 1, key[:-1])[0])
        if key == 'Frames:':
            frames = int(number)
            if frames != number or frames < 1:
                raise MotionFileError(path, line, f'saw {number:g} frames, wanted one at least')
            if frames * count > MAX_MOTION:
                seen = f'{frames} frames of {count} channels'
                raise MotionFileError(path, line, f'{seen}, wanted {MAX_MOTION} numbers at most')
        else:
            frame_time = number
            if frame_time <= 0:
                raise MotionFileError(path, line, f'frame time {number:g} s, wanted more than 0')
    if len(header) < 2:
        raise MotionFileError(path, len(lines), 'the file ends, wanted Frames: and Frame Time:')
    if count == 0:
        raise MotionFileError(path, None, 'no joint has CHANNELS, wanted some')
    values, rows = np.empty((frames, count)), 0
    for i in range(at, len(lines)):
        words = lines[i].split()
        if words:
            values[rows % frames] = numbers(path, i + 1, words, count, f'frame {rows + 1}')
            rows += 1
    if rows != frames:
        raise MotionFileError(path, len(lines), f'saw {rows} frames, wanted {frames}')
    return values, frame_time


def _rig(path: Path, joints: list[_Joint], values: Array) -> tuple[Rig, Array]:
    """The rig and its channels' values; translations come first, constant ones become offsets."""
    segments: list[RigSegment] = []
    tips: list[RigJoint] = []
    place: dict[int, int] = {}  # joint -> segment
    columns: list[Array] = []
    at = 0
    names: set[str] = set()
    for i, joint in enumerate(joints):
        if joint.name in names and not joint.is_tip:
            raise MotionFileError(path, joint.line, f'a second joint {joint.name!r}, wanted one')
        names.add(joint.name)
        parent = place.get(joint.parent, -1)
        offset = np.array(joint.offset, dtype=np.float64)
        own = values[:, at : at + len(joint.channels)]
        at += len(joint.channels)
        if joint.is_tip:
            tips.append(RigJoint(joint.name, parent, offset, joint.name))
            continue
        shifts = [k for k, (_, is_rotation) in enumerate(joint.channels) if not is_rotation]
        turns = [k for k, (_, is_rotation) in enumerate(joint.channels) if is_rotation]
        shift_axes = [joint.channels[k][0] for k in shifts]
        moved = own[:, shifts]
        middle = np.zeros(3)
        middle[shift_axes] = np.median(moved, axis=0) if shifts else 0.0
        if middle @ offset > 0.5 * (offset @ offset) > 0:
            moved = moved - offset[shift_axes]  # the channels replace OFFSET
        if parent >= 0 and shifts and np.all(moved == moved[0]):
            offset[shift_axes] += moved[0]
            shifts, shift_axes, moved = [], [], moved[:, :0]
        columns += [moved, own[:, turns]]
        place[i] = len(segments)
        segments.append(
            RigSegment(
                name=joint.name,
                parent=parent,
                offset=offset,
                length_name=joint.name,
                channels=(
                    *(Channel(axis, False) for axis in shift_axes),
                    *(Channel(joint.channels[k][0], True) for k in turns),
                ),
                mount=np.eye(3),
            )
        )
    return Rig(tuple(segments), tuple(tips)), np.concatenate(columns, axis=1)
