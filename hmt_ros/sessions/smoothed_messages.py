"""Messages about a smoothed window; for a tracked image see `track_messages`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from hmt_ros.body import Body
from hmt_ros.body.mirror import propagated, turn_jacobians, turned
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.session import PublishedTopic
from hmt_ros.sessions.track_messages import MESSAGES, links_of
from hmt_ros.smoothing import FinalPose, TrajectoryMixture
from msg_tools.messages.markers import trajectory_markers
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)
from msg_tools.messages.states import heaviest_joint_state, transforms_message
from msg_tools.messages.trajectory_mixtures import TrajectoryMixture as TrajectoryContent
from msg_tools.messages.trajectory_mixtures import trajectory_mixture_message

# Topics, in the order in which they are published.
TOPICS = {
    'trajectory_mixture': PublishedTopic('hmt_msgs/msg/TrajectoryMixture'),
    'trajectory_markers': PublishedTopic('visualization_msgs/msg/MarkerArray'),
    'smoothed_pose_mixture': PublishedTopic('hmt_msgs/msg/PoseMixture'),
    'smoothed_joint_states': PublishedTopic('sensor_msgs/msg/JointState'),
    '/tf': PublishedTopic('tf2_msgs/msg/TFMessage'),
}
TRACED_JOINTS = ('pelvis', 'head', 'left_wrist', 'right_wrist', 'left_ankle', 'right_ankle')
# Maximum number of trajectories that are drawn, heaviest first.
MAX_DRAWN_TRAJECTORIES = 8


@dataclass(frozen=True, eq=False)
class SmoothedBody:
    """The person whose poses are smoothed.

    Attributes:
        body: body with the present segment lengths.
        frame_id: frame of the poses.
        track_id: number of the track of the filter; 0: unknown.
    """

    body: Body
    frame_id: str
    track_id: int = 0


class OpenPose(NamedTuple):
    """Fields of a filter's mixture that are published with the smoothed pose.

    Attributes:
        state: state of the track in the filter.
        existence: probability, from the filter, that a person is in view; NaN: unknown.
        shape: (d, d) covariance of the errors that are the same in all images; None: unknown.
    """

    state: TrackState
    existence: float
    shape: Array | None


def trajectory_content(
    found: TrajectoryMixture, of: SmoothedBody, *, covariances: bool, shapes: Mapping[int, Array]
) -> TrajectoryContent:
    """Return the content of a message with a mixture over trajectories.

    Args:
        found: trajectories, with stamps.
        covariances: whether the message contains covariances.
        shapes: covariances (d, d), by stamp, of errors that are the same in all images; they are
            added to the covariances of the poses.
    """
    content = found.message_content(covariances=covariances)
    if covariances:
        wide = _symmetric(content['marginal_covariances'])
        for t, stamp in enumerate(content['stamps_ns']):
            wide[:, t] += shapes.get(stamp, 0.0)
        content['marginal_covariances'] = wide
    if (camera := of.body.levelled(np.eye(3))) is not of.body:
        means = found.means.reshape(-1, of.body.dimension)
        placed = turned(of.body, means, camera)
        content['means'] = placed.reshape(found.means.shape)
        if covariances:
            jacobians = turn_jacobians(of.body, means, camera, placed)
            flat = content['marginal_covariances'].reshape(jacobians.shape)
            content['marginal_covariances'] = propagated(jacobians, flat).reshape(wide.shape)
    return TrajectoryContent(
        **content,
        body_model=of.body.name,
        dof_names=of.body.dof_names,
        frame_id=of.frame_id,
        segment_lengths=of.body.segment_lengths,
        joint_names=of.body.joint_names,
        joint_positions=_joints(found.means, of.body),
    )


def window_messages(
    found: TrajectoryMixture,
    of: SmoothedBody,
    wanted: Callable[[str], bool],
    *,
    covariances: bool,
    shapes: Mapping[int, Array],
) -> Iterator[tuple[str, Any]]:
    """Yields topics and messages of a window; for arguments see `trajectory_content`."""
    if wanted('trajectory_mixture'):
        content = trajectory_content(found, of, covariances=covariances, shapes=shapes)
        yield 'trajectory_mixture', trajectory_mixture_message(MESSAGES, content)
    if wanted('trajectory_markers'):
        assert found.stamps_ns is not None
        chosen = np.argsort(-found.weights, kind='stable')[:MAX_DRAWN_TRAJECTORIES]
        joints, stamp = _joints(found.means[chosen], of.body), found.stamps_ns[-1]
        yield 'trajectory_markers', _markers(of, joints, found.weights[chosen], stamp)


def final_messages(
    pose: FinalPose,
    of: SmoothedBody,
    told: OpenPose,
    wanted: Callable[[str], bool],
    *,
    frame_prefix: str | None,
) -> Iterator[tuple[str, Any]]:
    """Yields topics and messages of a pose that will not be revised.

    Args:
        frame_prefix: prefix of link names on /tf; None: transforms are not published.

    Raises:
        MessageError: the mixture is not valid in a message.
    """
    shows_links = frame_prefix is not None and wanted('/tf')
    if not (wanted('smoothed_pose_mixture') or wanted('smoothed_joint_states') or shows_links):
        return
    mixture = with_shape(pose.mixture, told.shape)
    content = PoseMixture.of_body(
        of.body,
        replace(mixture, covariances=_symmetric(mixture.covariances)),
        MixtureKind.SMOOTHED,
        pose.stamp_ns,
        of.frame_id,
        state=told.state,
        track_id=of.track_id,
        existence_probability=told.existence,
        identities=np.array(pose.identities),
        velocities=pose.velocities,
    )
    if wanted('smoothed_pose_mixture'):
        yield 'smoothed_pose_mixture', pose_mixture_message(MESSAGES, content)
    if wanted('smoothed_joint_states'):
        yield 'smoothed_joint_states', heaviest_joint_state(MESSAGES, content)
    if shows_links:
        heaviest = content.means[int(np.argmax(content.weights))]
        names, rotations, origins = links_of(of.body.levelled(np.eye(3)), heaviest)
        children = [f'{frame_prefix}{name}' for name in names]
        parents, stamp = [of.frame_id] * len(names), pose.stamp_ns
        yield '/tf', transforms_message(MESSAGES, parents, children, rotations, origins, stamp)


def with_shape(mixture: GaussianMixture, shape: Array | None) -> GaussianMixture:
    """Add the covariance (d, d) of errors shared by all images to a mixture; None adds nothing."""
    if shape is None:
        return mixture
    return replace(mixture, covariances=mixture.covariances + shape)


def nobody_messages(
    of: SmoothedBody, stamp_ns: int, existence: float, wanted: Callable[[str], bool]
) -> Iterator[tuple[str, Any]]:
    """Yields topics and messages that say that nobody is in view any more.

    Args:
        of: person of the previous poses.
        existence: probability that a person is in view; NaN: unknown.
    """
    if wanted('trajectory_markers'):
        nothing = np.empty((0, 0, len(of.body.joint_names), 3))
        yield 'trajectory_markers', _markers(of, nothing, np.empty(0), stamp_ns)
    if wanted('smoothed_pose_mixture'):
        content = PoseMixture.of_body(
            of.body,
            None,
            MixtureKind.SMOOTHED,
            stamp_ns,
            of.frame_id,
            state=TrackState.NOBODY,
            track_id=of.track_id,
            existence_probability=existence,
        )
        yield 'smoothed_pose_mixture', pose_mixture_message(MESSAGES, content)


def _markers(of: SmoothedBody, joints: Array, weights: Array, stamp_ns: int) -> Any:
    """Return markers of joint positions (M, T, J, 3); they replace all earlier markers."""
    names = of.body.joint_names
    edges = [(names[a], names[b]) for a, b in of.body.skeleton.bones]
    return trajectory_markers(
        MESSAGES,
        joints,
        names,
        TRACED_JOINTS,
        edges,
        weights,
        stamp_ns,
        of.frame_id,
        ranks=MAX_DRAWN_TRAJECTORIES,
    )


def _joints(means: Array, body: Body) -> Array:
    """Return the joint positions (M, T, J, 3) of trajectories (M, T, d)."""
    joints = body.joint_positions(means.reshape(-1, body.dimension))
    return joints.reshape(*means.shape[:2], len(body.joint_names), 3)


def _symmetric(covariances: Array) -> Array:
    """Remove the asymmetry of covariances that is due to rounding."""
    return 0.5 * (covariances + np.swapaxes(covariances, -1, -2))
