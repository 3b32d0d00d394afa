"""Scores of all mixtures that a bag carries, against the true joint positions.

Every topic of pose mixtures or trajectory mixtures is read once, in the order of the bag, and
scored in batches: memory does not grow with the length of the bag. Frames are matched by stamp.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_ros.app.recorded_bodies import BODY, RecordedBodies, body_topics
from hmt_ros.app.truth import Truth, is_truth, mixture_topics
from hmt_ros.body import Body
from hmt_ros.evaluation.pose_scores import (
    BATCH,
    EVALUATED_JOINTS,
    MODEL_SIGMA,
    ORIGIN,
    JointMixture,
    Scores,
    joint_mixtures,
    score,
)
from hmt_ros.inference import GaussianMixture
from msg_tools import BagMessage, BagReader, MessageError
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, pose_mixture_of
from msg_tools.messages.trajectory_mixtures import (
    TRAJECTORY_MIXTURE,
    TrajectoryMixture,
    trajectory_mixture_of,
)

Array = NDArray[np.float64]
_Content = TypeVar('_Content')

# Positions of joints in a message agree with the body's kinematics up to this, m.
SAME_PLACE = 1e-3


@dataclass(frozen=True)
class TopicScores:
    """Scores of one topic.

    Attributes:
        kind: what its mixtures are, e.g. 'posterior'.
        scores: of the frames that have a truth.
        missing: frames of the truth that the topic has no mixture for.
        without_truth: mixtures at whose stamp nothing is known.
        note: why densities are not known; '': they are.
    """

    kind: str
    scores: Scores
    missing: int
    without_truth: int
    note: str


@dataclass(frozen=True)
class _Pose:
    """A mixture over poses, or what is left of it without covariances or a body."""

    stamp: int
    weights: Array
    mixture: GaussianMixture | None
    positions: Array | None
    joint_names: tuple[str, ...]
    body: Body | None


@dataclass
class _Topic:
    """What has been read of a topic so far."""

    name: str
    truth: Truth
    joints: tuple[str, ...]
    model_sigma: float
    rng: np.random.Generator
    kind: str = ''
    note: str = ''
    without_truth: int = 0
    seen: set[int] = field(default_factory=set)
    waiting: list[_Pose] = field(default_factory=list)
    window: dict[int, _Pose] = field(default_factory=dict)
    parts: list[Scores] = field(default_factory=list)

    def take(self, pose: _Pose) -> None:
        """Takes a mixture whose stamp will not be revised."""
        if pose.stamp in self.seen:
            return
        if pose.stamp not in self.truth.joints:
            self.without_truth += 1
            return
        self.seen.add(pose.stamp)
        if self.waiting and self.waiting[-1].body is not pose.body:
            self.flush()
        self.waiting.append(pose)
        if len(self.waiting) == BATCH:
            self.flush()

    def flush(self) -> None:
        """Scores what waits; all of it has the same body."""
        poses, self.waiting = self.waiting, []
        if not poses:
            return
        body = poses[0].body
        for pose in poses:
            if pose.mixture is None or pose.body is None:
                self.note = self.note or 'no covariances, or no body that they are of'
                body = None
        if body is not None and self._elsewhere(body, poses[0]):
            self.note = f'joint positions are not those of the body {body.name} of the bag'
            body = None
        if body is None:
            mixtures = [self._bare(pose) for pose in poses]
        else:
            positions = [pose.positions for pose in poses if pose.positions is not None]
            mixtures = joint_mixtures(
                body,
                [pose.mixture for pose in poses if pose.mixture is not None],
                self.joints,
                model_sigma=self.model_sigma,
                positions=positions or None,
            )
        where = _indices(self.truth.joint_names, self.joints, self.truth.source)
        true = np.array([self.truth.joints[pose.stamp] for pose in poses])
        true = true[:, where[1:]] - true[:, where[:1]]
        self.parts.append(score(mixtures, true, self.joints, seed=self.rng))

    def finish(self) -> TopicScores:
        """All scores.

        Raises:
            ValueError: no frame has a truth.
        """
        for stamp in sorted(self.window):
            self.take(self.window[stamp])
        self.flush()
        if not self.parts:
            raise ValueError(
                f'no stamp of {self.name} is among those of {self.truth.source}, '
                f'{self.truth.span()}'
            )
        missing = len(self.truth.joints) - len(self.seen)
        return TopicScores(
            self.kind, Scores.concatenate(self.parts), missing, self.without_truth, self.note
        )

    def _elsewhere(self, body: Body, pose: _Pose) -> bool:
        if pose.positions is None or pose.mixture is None:
            return False
        if pose.joint_names != body.joint_names:
            return True
        computed = body.joint_positions(pose.mixture.means)
        return bool(np.abs(computed - pose.positions).max() > SAME_PLACE)

    def _bare(self, pose: _Pose) -> JointMixture:
        """Joint positions alone."""
        if pose.positions is None:
            raise ValueError(f'{self.name}: trajectories need the body, and the bag has none')
        where = _indices(pose.joint_names, self.joints, self.name)
        joints = pose.positions
        return JointMixture(pose.weights, joints[:, where[1:]] - joints[:, where[:1]])


def score_bag(
    path: Path,
    truth: Truth,
    *,
    topics: Iterable[str] = (),
    model_sigma: float = MODEL_SIGMA,
    body_model: str | None = None,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
) -> dict[str, TopicScores]:
    """Scores of the topics of a bag, by name in the order of the bag.

    Args:
        path: of the bag.
        truth: where the joints were.
        topics: names of those to score; none: all with mixtures.
        model_sigma: see `hmt_ros.evaluation.pose_scores`, m.
        body_model: name or file of the body where the bag's own name for it is not known; None: the
            bag's.
        seed: of the samples that coverage is estimated with.
        progress: called with the number of messages that were read.

    Raises:
        ValueError: no mixtures, messages that can not be understood, or no frame that has a truth.
    """
    with BagReader(path) as bag:
        names = chosen_topics(bag, topics)
        joints = _common_joints(truth)
        found = {
            name: _Topic(name, truth, joints, model_sigma, np.random.default_rng(seed))
            for name in names
        }
        bodies = RecordedBodies(body_model)
        for stored in bag.messages([*body_topics(bag), *names]):
            if stored.msgtype == BODY:
                bodies.learn(stored)
            elif stored.msgtype == POSE_MIXTURE:
                _read_pose(stored, found[stored.topic], bodies)
            else:
                _read_trajectories(stored, found[stored.topic], bodies)
            if progress is not None:
                progress(1)
        return {name: topic.finish() for name, topic in found.items()}


def chosen_topics(bag: BagReader, wanted: Iterable[str]) -> list[str]:
    """Topics of a bag with mixtures other than ground truth; those that are wanted, or all.

    Raises:
        ValueError: there are none, or one that is wanted has no mixtures.
    """
    poses = [name for name in mixture_topics(bag) if not is_truth(bag, name)]
    trajectories = [
        topic.name
        for topic in bag.topics.values()
        if topic.msgtype == TRAJECTORY_MIXTURE and topic.message_count
    ]
    present = [*poses, *trajectories]
    chosen = [bag.topic(name).name for name in wanted] or present
    for name in chosen:
        if name not in present:
            raise ValueError(f'{bag.path}: topic {name} has no mixtures to evaluate')
    if not chosen:
        raise ValueError(
            f'{bag.path} has no pose mixtures; it has {", ".join(bag.topics) or "no topics"}'
        )
    return chosen


def _common_joints(truth: Truth) -> tuple[str, ...]:
    """Those of the evaluated joints that the truth knows."""
    if ORIGIN not in truth.joint_names:
        raise ValueError(f'{truth.source} has no joint {ORIGIN}; it has {list(truth.joint_names)}')
    known = tuple(name for name in EVALUATED_JOINTS if name in truth.joint_names)
    if len(known) < 4:
        raise ValueError(
            f'{truth.source} knows {list(known)} of the evaluated joints, wanted 4 at least of '
            f'{list(EVALUATED_JOINTS)}'
        )
    return known


def _indices(names: tuple[str, ...], joints: tuple[str, ...], source: str) -> NDArray[np.intp]:
    missing = [name for name in (ORIGIN, *joints) if name not in names]
    if missing:
        raise ValueError(f'{source} has no joints {missing}; it has {list(names)}')
    return np.array([names.index(name) for name in (ORIGIN, *joints)], dtype=np.intp)


def _read_pose(stored: BagMessage, topic: _Topic, bodies: RecordedBodies) -> None:
    content = _content(pose_mixture_of, stored)
    _check_frame(topic, content.frame_id)
    topic.kind = content.kind.name.lower()
    if not len(content.weights):
        return  # nobody was seen: the frame is missing
    mixture = None if content.covariances is None else content.mixture
    body = None if mixture is None else bodies.of(stored.topic, content)
    topic.take(
        _Pose(
            content.stamp_ns, content.weights, mixture, content.joint_positions,
            content.joint_names, body,
        )
    )  # fmt: skip


def _read_trajectories(stored: BagMessage, topic: _Topic, bodies: RecordedBodies) -> None:
    """Takes the marginals of a window; those of an older window hold where no newer one reaches."""
    content = _content(trajectory_mixture_of, stored)
    _check_frame(topic, content.frame_id)
    topic.kind = 'trajectories'
    for stamp in sorted(topic.window):
        if stamp < content.stamps_ns[0]:
            topic.take(topic.window.pop(stamp))
    body = bodies.of(stored.topic, content)
    for t, stamp in enumerate(content.stamps_ns):
        topic.window[stamp] = _marginal(content, t, stamp, body)


def _content(read: Callable[[Any], _Content], stored: BagMessage) -> _Content:
    """The content of a message.

    Raises:
        ValueError: it can not be understood; one line that names it.
    """
    try:
        return read(stored.message)
    except MessageError as error:
        raise ValueError(f'{stored.topic} at {stored.log_time_ns} ns: {error}') from error


def _marginal(content: TrajectoryMixture, t: int, stamp: int, body: Body | None) -> _Pose:
    covariances = content.marginal_covariances
    mixture = None
    if covariances is not None:
        mixture = GaussianMixture(content.weights, content.means[:, t], covariances[:, t])
    positions = None if body is None else body.joint_positions(content.means[:, t])
    names = () if body is None else body.joint_names
    return _Pose(stamp, content.weights, mixture, positions, names, body)


def _check_frame(topic: _Topic, frame_id: str) -> None:
    wanted = topic.truth.frame_id
    if wanted and frame_id != wanted:
        raise ValueError(
            f'{topic.name} is in the frame {frame_id!r}, {topic.truth.source} in {wanted!r}'
        )
