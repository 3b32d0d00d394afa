"""All mixtures that a bag carries, as joint positions over time: what there is to be looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.app.bag_scores import chosen_topics
from hmt_ros.app.recorded_bodies import BODY, RecordedBodies, body_topics
from hmt_ros.app.report.recorded_track import Moment, RecordedTrack
from msg_tools import BagMessage, BagReader
from msg_tools.messages.message_error import MessageError
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, pose_mixture_of
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_of

Array = NDArray[np.float64]

# Joints whose ways trajectories are drawn as, and how many of the trajectories are kept.
ENDS = ('pelvis', 'head', 'left_wrist', 'right_wrist', 'left_ankle', 'right_ankle')
KEPT_TRAJECTORIES = 8
_ORDER = ('posterior', 'smoothed', 'likelihood', 'prediction', 'ground_truth')


@dataclass(frozen=True, eq=False)
class Layer:
    """The mixtures over poses on one topic.

    Attributes:
        topic: its name.
        kind: what they are the density of, e.g. 'posterior'.
        frame_id: of the positions.
        track: the mixtures, joint positions only.
    """

    topic: str
    kind: str
    frame_id: str
    track: RecordedTrack


@dataclass(frozen=True, eq=False)
class Window:
    """A mixture over trajectories.

    Attributes:
        stamp_ns: end of the window.
        stamps_ns: (T,) times of the poses.
        weights: (M,) of all trajectories, heaviest first.
        free_energy: (I,) per iteration, nats; empty: not recorded.
        ways: (at most `KEPT_TRAJECTORIES`, T, E, 3) of the `ENDS` that the body has, m, heaviest
            first; None: the body is not known.
    """

    stamp_ns: int
    stamps_ns: tuple[int, ...]
    weights: Array
    free_energy: Array
    ways: Array | None


@dataclass(frozen=True, eq=False)
class Trajectories:
    """The mixtures over trajectories on one topic.

    Attributes:
        topic: its name.
        frame_id: of the positions.
        ends: (E,) names of the joints whose ways are known.
        windows: in the order of time.
    """

    topic: str
    frame_id: str
    ends: tuple[str, ...]
    windows: list[Window]


@dataclass(frozen=True, eq=False)
class RecordedMixtures:
    """The mixtures of a bag.

    Attributes:
        layers: mixtures over poses, those of the posterior first.
        trajectories: mixtures over trajectories.
    """

    layers: list[Layer]
    trajectories: list[Trajectories]

    @property
    def stamps(self) -> list[int]:
        """All times of poses, increasing; those in windows where no pose stands alone."""
        stamps = {moment.stamp_ns for layer in self.layers for moment in layer.track.moments}
        windows = [window for topic in self.trajectories for window in topic.windows]
        stamps.update(window.stamp_ns for window in windows)
        if not self.layers:
            stamps.update(stamp for window in windows for stamp in window.stamps_ns)
        return sorted(stamps)

    def at(self, stamps: Iterable[int]) -> RecordedMixtures:
        """The mixtures at some times only; of windows those that end then, or else the last."""
        wanted = set(stamps)
        return RecordedMixtures(
            [
                replace(layer, track=replace(layer.track, moments=_at(layer.track.moments, wanted)))
                for layer in self.layers
            ],
            [
                replace(topic, windows=_at(topic.windows, wanted) or topic.windows[-1:])
                for topic in self.trajectories
            ],
        )


def _at(items: list[Any], wanted: set[int]) -> list[Any]:
    return [item for item in items if item.stamp_ns in wanted]


def read_mixtures(
    path: Path,
    *,
    topics: Sequence[str] = (),
    body_model: str | None = None,
    progress: Callable[[int], object] | None = None,
) -> RecordedMixtures:
    """The mixtures of a bag; of several on one topic with the same stamp, the first.

    Args:
        path: of the bag.
        topics: names of those to read; none: all with mixtures, but for ground truth.
        body_model: name or file of the body where the bag's own name for it is not known.
        progress: called with the number of messages that were read.

    Raises:
        ValueError: no mixtures, messages that can not be understood, several frames.
    """
    with BagReader(path) as bag:
        names = chosen_topics(bag, topics)
        reading = _Reading(body_model)
        for stored in bag.messages([*body_topics(bag), *names]):
            reading.take(stored)
            if progress is not None:
                progress(1)
    found = reading.finish(names)
    if not found.stamps:
        raise ValueError(f'{path}: nobody is seen in any mixture on {", ".join(names)}')
    _check_frames(path, found)
    return found


class _Reading:
    """What has been read so far."""

    def __init__(self, body_model: str | None) -> None:
        self._bodies = RecordedBodies(body_model)
        self._moments: dict[str, dict[int, Moment]] = {}
        self._windows: dict[str, dict[int, Window]] = {}
        self._about: dict[str, tuple[str, str, tuple[str, ...]]] = {}

    def take(self, stored: BagMessage) -> None:
        """Takes a message, of whatever type.

        Raises:
            ValueError: it can not be understood.
        """
        if stored.msgtype == BODY:
            self._bodies.learn(stored)
            return
        read = self._take_pose if stored.msgtype == POSE_MIXTURE else self._take_window
        message = stored.message
        try:
            read(stored.topic, message)
        except ValueError as error:
            raise ValueError(f'{stored.topic} at {stored.log_time_ns} ns: {error}') from error

    def _take_pose(self, topic: str, message: Any) -> None:
        content = pose_mixture_of(message)
        moments = self._moments.setdefault(topic, {})
        if not len(content.weights):
            return  # nobody was seen
        self._tell(topic, content.kind.name.lower(), content.frame_id, content.joint_names)
        order = np.argsort(-content.weights, kind='stable')
        stamp = content.stamp_ns
        moment = Moment(stamp, content.weights[order], content.joint_positions[order])
        moments.setdefault(stamp, moment)

    def _take_window(self, topic: str, message: Any) -> None:
        content = trajectory_mixture_of(message)
        body = self._bodies.of(topic, content)
        ends = () if body is None else tuple(x for x in ENDS if x in body.joint_names)
        self._tell(topic, 'trajectories', content.frame_id, ends)
        order = np.argsort(-content.weights, kind='stable')
        ways = None
        if body is not None:
            means = content.means[order[:KEPT_TRAJECTORIES]]
            joints = body.joint_positions(means.reshape(-1, body.dimension))
            ways = joints[:, body.skeleton.joint_index(ends)]
            ways = ways.reshape(*means.shape[:2], len(ends), 3)
        windows = self._windows.setdefault(topic, {})
        stamp = content.stamps_ns[-1]
        windows.setdefault(
            stamp,
            Window(stamp, content.stamps_ns, content.weights[order], content.free_energy, ways),
        )

    def _tell(self, topic: str, kind: str, frame_id: str, names: tuple[str, ...]) -> None:
        """Notes what a topic is about, which must not change."""
        about = kind, frame_id, names
        known = self._about.setdefault(topic, about)
        for what, was, seen in zip(('kind', 'frame', 'joints'), known, about, strict=True):
            if was != seen:
                raise MessageError(f'mixture has the {what} {seen!r}, before it was {was!r}')

    def finish(self, names: Sequence[str]) -> RecordedMixtures:
        """All that was read, by topic in this order, the posterior first."""
        layers, trajectories = [], []
        for name in names:
            if name not in self._about:
                continue
            kind, frame_id, joints = self._about[name]
            if name in self._windows:
                windows = [self._windows[name][stamp] for stamp in sorted(self._windows[name])]
                trajectories.append(Trajectories(name, frame_id, joints, windows))
            else:
                moments = [self._moments[name][stamp] for stamp in sorted(self._moments[name])]
                layers.append(Layer(name, kind, frame_id, RecordedTrack(joints, moments)))
        layers.sort(key=lambda layer: _ORDER.index(layer.kind))
        return RecordedMixtures(layers, trajectories)


def _check_frames(path: Path, found: RecordedMixtures) -> None:
    parts: list[Layer | Trajectories] = [*found.layers, *found.trajectories]
    first = parts[0]
    for part in parts[1:]:
        if part.frame_id != first.frame_id:
            raise ValueError(
                f'{path}: {part.topic} is in the frame {part.frame_id!r}, {first.topic} in '
                f'{first.frame_id!r}: name those of one camera by --topic'
            )
