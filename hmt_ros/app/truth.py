"""Reads true joint positions from a file of arrays or from the ground truth in a bag."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np

from hmt_ros.evaluation.ground_scores import TrueGround
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.transform_buffer import rotation_matrix
from msg_tools import BagReader
from msg_tools.files.array_file import read_archive
from msg_tools.files.budget import Budget
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, MixtureKind, pose_mixture_of

FIELDS = ('stamps', 'joint_names', 'joints')
_MAX_BYTES = 2**28  # maximum size of the arrays, bytes
_RECORDS_PER_FRAME = 4  # cost of a frame in the budget, records
_FLOOR_FIELDS = ('gravity', 'camera_height')


def read_truth(path: Path) -> Truth:
    """Reads the truth from a file of arrays (.npz) or from a bag.

    The file has `stamps` (T,) ns, `joint_names` (J,) and `joints` (T, J, 3) m in the camera optical
    frame, all NaN if nobody is in view. It can also have the floor: `gravity` (T, 3) and
    `camera_height` (T,) m, and with them `contact` (T, 2) of the left and right foot, and the pose
    of a moving camera in the world: `camera_position` (T, 3) m and `camera_quaternion` (T, 4)
    x y z w.

    Raises:
        ValueError: unsupported kind of file, or missing or inconsistent arrays.
    """
    if path.suffix == '.npz':
        return _from_arrays(path)
    truth = recorded_truth(path)
    if truth is None:
        raise ValueError(
            f'{path} has no ground truth: wanted a .npz file with {", ".join(FIELDS)}, or a '
            'bag with a topic of PoseMixture whose kind is GROUND_TRUTH'
        )
    return truth


def recorded_truth(path: Path) -> Truth | None:
    """The ground truth in a bag; None if missing.

    Raises:
        ValueError: the bag has several ground truths, or a message is invalid.
    """
    with BagReader(path) as bag:
        found = [x.name for x in bag.topics_of(POSE_MIXTURE) if is_truth(bag, x.name)]
        if len(found) > 1:
            raise ValueError(f'{bag.path} has several ground truths ({", ".join(found)})')
        return _truth_of(bag, found[0]) if found else None


def _from_arrays(path: Path) -> Truth:
    try:
        content = read_archive(path, _MAX_BYTES)
        missing = [name for name in FIELDS if name not in content]
        if missing:
            raise ValueError(f'it has no {missing}; it has {sorted(content)}')
        stamps, names, joints = (content[name] for name in FIELDS)
        Budget(path.stat().st_size).spend(records=_RECORDS_PER_FRAME * stamps.size)
    except OSError as error:
        raise ValueError(f'{path} can not be read ({error.strerror or error})') from error
    except ValueError as error:
        raise ValueError(f'{path} is no truth file: {error}') from error
    if stamps.ndim != 1 or not np.issubdtype(stamps.dtype, np.integer):
        raise ValueError(f'{path}: stamps must be whole nanoseconds (T,), saw {stamps.dtype}')
    if joints.ndim != 3 or not np.issubdtype(joints.dtype, np.number):
        raise ValueError(f'{path}: joints must be numbers (T, J, 3), saw {joints.shape}')
    if len(stamps) != len(joints):
        raise ValueError(f'{path}: {len(stamps)} stamps for {len(joints)} frames of joints')
    pairs = zip(stamps, joints.astype(np.float64), strict=True)
    frames = {int(t): x for t, x in pairs if not np.isnan(x).all()}
    ground = _ground(path, content, stamps)
    return Truth(str(path), tuple(str(name) for name in np.ravel(names)), frames, ground=ground)


def _ground(path: Path, content: Mapping[str, Array], stamps: Array) -> dict[int, TrueGround]:
    """The true floor in a file; empty if gravity or height of the camera are missing."""
    if not set(_FLOOR_FIELDS) <= content.keys():
        return {}
    shapes = {'gravity': (3,), 'camera_height': (), 'contact': (2,)}
    shapes |= {'camera_position': (3,), 'camera_quaternion': (4,)}
    known = {}
    for name, shape in shapes.items():
        if name in content:
            known[name] = np.asarray(content[name], dtype=np.float64)
            if known[name].shape != (len(stamps), *shape):
                raise ValueError(
                    f'{path}: {name} has shape {known[name].shape}, wanted {(len(stamps), *shape)}'
                )
    with np.errstate(over='ignore'):
        lengths = np.linalg.norm(known['gravity'], axis=1)
    if not ((lengths > 0) & np.isfinite(lengths) & np.isfinite(known['camera_height'])).all():
        raise ValueError(f'{path}: gravity or camera_height is zero or not finite somewhere')
    # A camera without a given pose is assumed to be at rest.
    moves = {'camera_position', 'camera_quaternion'} <= known.keys()
    return {
        int(stamp): TrueGround(
            up=-known['gravity'][i] / lengths[i],
            height=float(known['camera_height'][i]),
            standing=known['contact'][i] > 0 if 'contact' in known else None,
            camera_rotation=rotation_matrix(known['camera_quaternion'][i]) if moves else np.eye(3),
            camera_position=known['camera_position'][i] if moves else np.zeros(3),
        )
        for i, stamp in enumerate(stamps)
    }


def is_truth(bag: BagReader, topic: str) -> bool:
    """Whether the mixtures on a topic are ground truth."""
    first = next(bag.messages([topic]), None)
    return first is not None and int(first.message.kind) == MixtureKind.GROUND_TRUTH


def _truth_of(bag: BagReader, topic: str) -> Truth:
    """The ground truth on a topic of a bag."""
    source = f'{bag.path} ({topic})'
    joints: dict[int, Array] = {}
    names: tuple[str, ...] | None = None
    frame_id = ''
    for stored in bag.messages([topic]):
        content = stored.content(partial(pose_mixture_of, joint_names=names))
        names, frame_id = content.joint_names, frame_id or content.frame_id
        if len(content.weights):
            joints[content.stamp_ns] = content.joint_positions[0]
    return Truth(source, names or (), joints, frame_id)
