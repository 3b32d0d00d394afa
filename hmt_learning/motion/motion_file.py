"""Motions from files: BVH, and ASF/AMC (the mocap skeletons of BME, with 56 and more dimensions).

Motion files differ in axes and units. `read_motion` converts lengths to metres and angles to
radians and keeps the file's axes for poses; `Motion.joint_positions` gives joints in a world frame
that is the same for every file: z up, right-handed, metres, origin and heading as recorded. For a
file with y up, world x, y, z are its x, -z, y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hmt_learning.motion.acclaim import Acclaim, read_amc, read_asf
from hmt_learning.motion.bvh import read_bvh
from hmt_learning.motion.rig import MotionFileError, Rig, read_text, rig_body
from hmt_ros.body.body import Body
from hmt_ros.inference.arrays import Array

__all__ = ['Motion', 'MotionFileError', 'read_motion', 'read_skeleton']


# Rows are the world axes x, y, z in the file's axes; each is a rotation.
WORLD_FROM_FILE = {
    'y': ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    'z': ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    'x': ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    '-y': ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    '-z': ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    '-x': ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
}

# m, cm, mm, inches, and CMU's inches / 0.45; tried before the unit is derived from PERSON.
COMMON_UNITS = (1.0, 0.01, 0.001, 0.0254, 0.0254 / 0.45)
PERSON = 1.7  # stature for a unit that is not common, m
PERSONS = (1.5, 2.0)  # statures that make a common unit plausible, m
LIMBS = 0.79  # length of a leg and an arm, hip to ankle and shoulder to wrist, over the stature
REACH = 1.4  # toe to fingertip along the bones, over the stature; for unknown names
CMU_RATE = 120.0  # frames per second of AMC files, which do not state it


@dataclass(frozen=True, eq=False)
class Motion:
    """A recorded motion.

    Attributes:
        name: name of the file without its suffix.
        body: body with the file's skeleton, without flesh; m and rad. Its joints have standard
            names (`left_hip`) if those of the file are known, otherwise the names of the file.
        poses: (T, d) poses of that body in the axes of the file, as recorded: they may exceed the
            limits of the ASF.
        fps: frames per second.
        world_from_file: (3, 3) rotation from the file's axes to the world with z up.
        unit_to_m: metres per unit of length of the file.

    Raises:
        ValueError: the shapes do not fit, or there are no frames.
    """

    name: str
    body: Body
    poses: Array
    fps: float
    world_from_file: Array
    unit_to_m: float

    def __post_init__(self) -> None:
        shape, d = self.poses.shape, self.body.dimension
        if self.poses.ndim != 2 or shape[1] != d or shape[0] == 0:
            raise ValueError(f'poses of {self.name} have shape {shape}, wanted (T, {d}) with T > 0')
        if not (np.isfinite(self.fps) and self.fps > 0):
            raise ValueError(f'frame rate of {self.name} must be positive, saw {self.fps}')
        if self.world_from_file.shape != (3, 3):
            shape = self.world_from_file.shape
            raise ValueError(f'world_from_file has shape {shape}, wanted (3, 3)')
        for array in (self.poses, self.world_from_file):
            array.setflags(write=False)

    def __len__(self) -> int:
        return len(self.poses)

    def joint_positions(self, names: Sequence[str] | None = None) -> Array:
        """Positions (T, J, 3) of some or of all joints in the world frame (z up), m.

        Raises:
            KeyError: the body does not have a joint.
        """
        joints = self.body.joint_positions(self.poses)
        if names is not None:
            joints = joints[:, self.body.skeleton.joint_index(tuple(names))]
        return joints @ self.world_from_file.T

    def part(self, start: int = 0, stop: int | None = None, step: int = 1) -> Motion:
        """Every step-th of the frames from start to stop.

        Raises:
            ValueError: the step is below 1, or no frame is left.
        """
        if step < 1:
            raise ValueError(f'step must be at least 1, saw {step}')
        return replace(self, poses=self.poses[start:stop:step].copy(), fps=self.fps / step)


def read_motion(
    path: str | Path,
    *,
    skeleton: str | Path | None = None,
    unit_to_m: float | None = None,
    up_axis: str | None = None,
    fps: float | None = None,
) -> Motion:
    """Motion of a .bvh or .amc file.

    Args:
        skeleton: ASF of an AMC; None selects the .asf of the same name beside the file.
        unit_to_m: metres per unit of length. None selects that of the ASF; for a BVH the first of
            metres, centimetres, millimetres, inches and CMU's 5.6444 cm that makes the skeleton a
            person of 1.5 to 2.0 m, otherwise the unit that makes it 1.7 m.
        up_axis: 'x', 'y', 'z', '-x', '-y' or '-z'. None selects the axis nearest to the mean
            direction from the ankles to the head, or y if that is not clear.
        fps: frames per second. None selects the rate in a BVH, and 120 for an AMC.

    Raises:
        FileNotFoundError: the file, or the ASF of an AMC, does not exist.
        MotionFileError: the file can not be read; one line with file and line number.
        ValueError: an argument is out of its range.
    """
    path = Path(path)
    _check(unit_to_m, up_axis, fps)
    kind = path.suffix.lower()
    if kind == '.bvh':
        rig, values, frame_time = read_bvh(path, read_text(path))
        values = values * np.where(rig.is_rotation, np.pi / 180, 1.0)
        unit = unit_to_m or _guessed_unit(rig)
        rate = fps or 1.0 / frame_time
    elif kind == '.amc':
        acclaim = _read_asf(_skeleton_of(path, skeleton))
        rig = acclaim.rig
        values = read_amc(path, read_text(path), acclaim)
        unit = unit_to_m or acclaim.unit_to_m
        rate = fps or CMU_RATE
    elif kind == '.asf':
        raise MotionFileError(path, None, 'an ASF has no motion, wanted its AMC or a BVH')
    else:
        raise MotionFileError(path, None, f'saw suffix {kind!r}, wanted .bvh or .amc')
    body = rig_body(rig, path.stem, unit)
    poses = values * np.where(rig.is_rotation, 1.0, unit)
    axis = up_axis or _guessed_up_axis(body, poses)
    turn = np.array(WORLD_FROM_FILE[axis], dtype=np.float64)
    return Motion(path.stem, body, poses, rate, turn, unit)


def read_skeleton(path: str | Path, *, unit_to_m: float | None = None) -> Body:
    """Body of the skeleton of a .bvh, .asf or .amc file, without flesh; units as in `read_motion`.

    Raises:
        FileNotFoundError, MotionFileError, ValueError: as `read_motion`.
    """
    path = Path(path)
    _check(unit_to_m, None, None)
    if path.suffix.lower() != '.asf':
        return read_motion(path, unit_to_m=unit_to_m).body
    acclaim = _read_asf(path)
    return rig_body(acclaim.rig, path.stem, unit_to_m or acclaim.unit_to_m)


def _check(unit_to_m: float | None, up_axis: str | None, fps: float | None) -> None:
    for name, value in (('unit_to_m', unit_to_m), ('fps', fps)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ValueError(f'{name} must be a positive number, saw {value}')
    if up_axis is not None and up_axis not in WORLD_FROM_FILE:
        raise ValueError(f'up_axis must be one of {sorted(WORLD_FROM_FILE)}, saw {up_axis!r}')


def _read_asf(path: Path) -> Acclaim:
    return read_asf(path, read_text(path))


def _skeleton_of(path: Path, skeleton: str | Path | None) -> Path:
    if skeleton is not None:
        return Path(skeleton)
    for suffix in ('.asf', '.ASF'):
        if path.with_suffix(suffix).is_file():
            return path.with_suffix(suffix)
    if not path.is_file():
        raise FileNotFoundError(f'no motion file {path}')
    missing = path.with_suffix('.asf').name
    raise FileNotFoundError(f'{path} needs its skeleton: no {missing} beside it, none given')


def _guessed_unit(rig: Rig) -> float:
    """Metres per unit; see `read_motion`."""
    spans = [float(np.linalg.norm(joint.offset)) for joint in rig.joints]
    names = rig.standard_names()
    limbs = [f'left_{joint}' for joint in ('knee', 'ankle', 'elbow', 'wrist')]
    if set(limbs) <= set(names):
        stature = sum(spans[names.index(joint)] for joint in limbs) / LIMBS
    else:
        stature = _longest_way([joint.parent for joint in rig.joints], spans) / REACH
    if stature == 0:
        return 1.0
    for unit in COMMON_UNITS:
        if PERSONS[0] <= unit * stature <= PERSONS[1]:
            return unit
    return PERSON / stature


def _longest_way(parents: Sequence[int], spans: Sequence[float]) -> float:
    """Length of the longest path through the skeleton from one tip to another."""
    reach = [0.0] * len(spans)
    longest = 0.0
    for joint in range(len(spans) - 1, -1, -1):
        parent = parents[joint]
        if parent >= 0:
            way = reach[joint] + spans[joint]
            longest = max(longest, way + reach[parent])
            reach[parent] = max(reach[parent], way)
    return longest


def _guessed_up_axis(body: Body, poses: Array) -> str:
    """The vertical axis of a standing person; see `read_motion`."""
    names = ('left_ankle', 'right_ankle', 'head')
    if not set(names) <= set(body.joint_names):
        return 'y'
    places = body.joint_positions(poses)[:, body.skeleton.joint_index(names)]
    left, right, head = places.mean(axis=0)
    up = head - 0.5 * (left + right)
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) < 0.7 * np.linalg.norm(up):
        return 'y'
    return ('' if up[axis] > 0 else '-') + 'xyz'[axis]
