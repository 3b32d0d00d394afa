"""True joint positions, from a file of arrays or from the ground truth that a bag carries."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msg_tools import BagReader, MessageError
from msg_tools.files.array_file import read_archive
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, MixtureKind, pose_mixture_of

Array = NDArray[np.float64]

FIELDS = ('stamps', 'joint_names', 'joints')


@dataclass(frozen=True, eq=False)
class Truth:
    """Where the joints of a person were.

    Attributes:
        source: where this comes from, for messages.
        joint_names: (J,).
        joints: stamp in ns -> (J, 3) m, camera optical frame.
        frame_id: of the positions; '': not told.

    Raises:
        ValueError: no frames, or positions that do not fit the names or are not finite.
    """

    source: str
    joint_names: tuple[str, ...]
    joints: dict[int, Array]
    frame_id: str = ''

    def __post_init__(self) -> None:
        if not self.joints:
            raise ValueError(f'{self.source} has no frames')
        wanted = (len(self.joint_names), 3)
        for stamp, positions in self.joints.items():
            if positions.shape != wanted:
                raise ValueError(
                    f'{self.source}: joints at {stamp} ns have shape {positions.shape}, '
                    f'wanted {wanted}'
                )
            if not np.isfinite(positions).all():
                raise ValueError(f'{self.source}: joints at {stamp} ns are not finite')

    def span(self) -> str:
        """First and last stamp, for messages."""
        return f'{min(self.joints)} to {max(self.joints)} ns'


def read_truth(path: Path) -> Truth:
    """Truth of a file of arrays (.npz) or of a bag.

    The file has `stamps` (T,) ns, `joint_names` (J,) and `joints` (T, J, 3) m in the camera optical
    frame.

    Raises:
        ValueError: neither, or arrays that are missing or do not fit each other.
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
    """The truth that a bag carries, None when it has none.

    Raises:
        ValueError: there are several, or messages that can not be understood.
    """
    with BagReader(path) as bag:
        topic = _truth_topic(bag)
        return None if topic is None else _truth_of(bag, topic)


def _from_arrays(path: Path) -> Truth:
    try:
        content = read_archive(path)
        missing = [name for name in FIELDS if name not in content]
        if missing:
            raise ValueError(f'it has no {missing}; it has {sorted(content)}')
        stamps, names, joints = (content[name] for name in FIELDS)
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
    frames = {int(t): x.astype(np.float64) for t, x in zip(stamps, joints, strict=True)}
    return Truth(str(path), tuple(str(name) for name in np.ravel(names)), frames)


def _truth_topic(bag: BagReader) -> str | None:
    """The topic of a bag that carries the ground truth, None when it has none.

    Raises:
        ValueError: there are several.
    """
    found = [topic for topic in mixture_topics(bag) if is_truth(bag, topic)]
    if len(found) > 1:
        raise ValueError(f'{bag.path} has several ground truths ({", ".join(found)})')
    return found[0] if found else None


def mixture_topics(bag: BagReader) -> list[str]:
    """Topics of pose mixtures that have messages."""
    return [
        topic.name
        for topic in bag.topics.values()
        if topic.msgtype == POSE_MIXTURE and topic.message_count
    ]


def is_truth(bag: BagReader, topic: str) -> bool:
    """Whether the mixtures of a topic are known poses."""
    first = next(bag.messages([topic]), None)
    return first is not None and int(first.message.kind) == MixtureKind.GROUND_TRUTH


def _truth_of(bag: BagReader, topic: str) -> Truth:
    """The truth that a topic of a bag carries.

    Raises:
        ValueError: messages that contradict each other or have no component.
    """
    source = f'{bag.path} ({topic})'
    joints: dict[int, Array] = {}
    names: tuple[str, ...] | None = None
    frame_id = ''
    for stored in bag.messages([topic]):
        try:
            content = pose_mixture_of(stored.message, None, names)
            if not len(content.weights):
                raise MessageError('mixture has no components')
        except MessageError as error:
            raise ValueError(f'{source}: message at {stored.log_time_ns} ns: {error}') from error
        names, frame_id = content.joint_names, frame_id or content.frame_id
        joints[content.stamp_ns] = content.joint_positions[0]
    return Truth(source, names or (), joints, frame_id)
