"""Scores of the mixtures in a bag against the true joint positions.

Each topic of pose mixtures or trajectory mixtures is one track; the bag is read once, in its order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

from hmt_ros.app.recorded_bodies import BODY, RecordedBodies, body_topics
from hmt_ros.app.truth import is_truth, mixture_topics
from hmt_ros.body import Body
from hmt_ros.evaluation.ground_scores import GravityScores, gravity_scores
from hmt_ros.evaluation.pose_scores import MODEL_SIGMA
from hmt_ros.evaluation.track_scores import Estimate, TrackScorer, TrackScores, Truth
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from msg_tools import BagMessage, BagReader, MessageError
from msg_tools.messages.ground import GROUND, ground_of
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, pose_mixture_of
from msg_tools.messages.trajectory_mixtures import (
    TRAJECTORY_MIXTURE,
    TrajectoryMixture,
    trajectory_mixture_of,
)

_Content = TypeVar('_Content')


def score_bag(
    path: Path,
    truth: Truth,
    *,
    topics: Iterable[str] = (),
    model_sigma: float = MODEL_SIGMA,
    body_model: str | None = None,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
) -> dict[str, TrackScores]:
    """Scores of the topics of a bag, by name in the order of the bag.

    Args:
        path: path of the bag.
        truth: true joint positions.
        topics: names of the topics to score; empty: all topics with mixtures.
        model_sigma: see `hmt_ros.evaluation.pose_scores`, m.
        body_model: name or file of the body model, for a bag whose own name for it is unknown;
            None: the model that the bag names.
        seed: of the samples from which coverage is estimated.
        progress: called with the number of messages that were read.

    Raises:
        ValueError: no mixtures, messages that can not be understood, or no frame with a truth.
    """
    with BagReader(path) as bag:
        names = chosen_topics(bag, topics)
        found = {
            name: TrackScorer(name, truth, model_sigma=model_sigma, seed=seed) for name in names
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
        return {name: track.finish() for name, track in found.items()}


def score_gravity(path: Path, truth: Truth) -> dict[str, GravityScores]:
    """Scores of the verticals in a bag, by topic; those of which nothing is true are left out.

    Raises:
        ValueError: messages that can not be understood.
    """
    with BagReader(path) as bag:
        ups: dict[str, dict[int, tuple[Array, float]]] = {
            topic.name: {} for topic in bag.topics.values() if topic.msgtype == GROUND
        }
        if not ups or not truth.ground:
            return {}
        for stored in bag.messages(ups):
            content = _content(ground_of, stored)
            ups[stored.topic][content.stamp_ns] = content.up, content.up_sigma
    found = {name: gravity_scores(mine, truth.ground) for name, mine in ups.items()}
    return {name: scores for name, scores in found.items() if scores is not None}


def message_count(path: Path, topics: Iterable[str] = ()) -> int:
    """Number of messages that `score_bag` reads.

    Raises:
        ValueError: see `chosen_topics`.
    """
    with BagReader(path) as bag:
        return bag.message_count({*body_topics(bag), *chosen_topics(bag, topics)})


def chosen_topics(bag: BagReader, wanted: Iterable[str]) -> list[str]:
    """Topics of a bag with mixtures other than ground truth: the wanted ones, or all.

    Raises:
        ValueError: there are none, or a wanted one has no mixtures.
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


def _read_pose(stored: BagMessage, track: TrackScorer, bodies: RecordedBodies) -> None:
    content = _content(pose_mixture_of, stored)
    _check_frame(track, content.frame_id)
    track.kind = content.kind.name.lower()
    if not len(content.weights):
        return  # nobody was seen: the frame is missing
    mixture = None if content.covariances is None else content.mixture
    body = None if mixture is None else bodies.of(stored.topic, content)
    track.take(
        Estimate(
            content.stamp_ns, content.weights, mixture, content.joint_positions,
            content.joint_names, body,
        )
    )  # fmt: skip


def _read_trajectories(stored: BagMessage, track: TrackScorer, bodies: RecordedBodies) -> None:
    """Takes the marginals of a window."""
    content = _content(trajectory_mixture_of, stored)
    _check_frame(track, content.frame_id)
    track.kind = 'trajectories'
    body = bodies.of(stored.topic, content)
    track.take_window([_marginal(content, t, body) for t in range(len(content.stamps_ns))])


def _content(read: Callable[[Any], _Content], stored: BagMessage) -> _Content:
    """The content of a message.

    Raises:
        ValueError: it can not be understood; one line that names it.
    """
    try:
        return read(stored.message)
    except MessageError as error:
        raise ValueError(f'{stored.topic} at {stored.log_time_ns} ns: {error}') from error


def _marginal(content: TrajectoryMixture, t: int, body: Body | None) -> Estimate:
    covariances = content.marginal_covariances
    mixture = None
    if covariances is not None:
        mixture = GaussianMixture(content.weights, content.means[:, t], covariances[:, t])
    positions = None if body is None else body.joint_positions(content.means[:, t])
    names = () if body is None else body.joint_names
    return Estimate(content.stamps_ns[t], content.weights, mixture, positions, names, body)


def _check_frame(track: TrackScorer, frame_id: str) -> None:
    wanted = track.truth.frame_id
    if wanted and frame_id != wanted:
        raise ValueError(
            f'{track.name} is in the frame {frame_id!r}, {track.truth.source} in {wanted!r}'
        )
