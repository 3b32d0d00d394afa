"""Messages about a tracked image.

`TOPICS` lists the names and types of the topics. The functions are generators that make one message
at a time. A message depends only on the track and the image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmt_ros.body import Body
from hmt_ros.body.kinematics import forward
from hmt_ros.body.mirror import turned
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.inference.linear_algebra import product
from hmt_ros.sessions.camera_session import WaitingImage
from hmt_ros.sessions.fixed_frame import OPTICAL_TO_BODY, FixedFrame, upright
from hmt_ros.sessions.focal_length import depth_covariances
from hmt_ros.sessions.handled import Output
from hmt_ros.sessions.overlay import draw_modes, draw_notes
from hmt_ros.sessions.robot_outputs import RobotOutputs
from hmt_ros.sessions.session import PublishedTopic
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.tracking import Status, Tracker
from msg_tools import RosbagsMessages
from msg_tools.messages.bodies import description_message, message_of_body
from msg_tools.messages.ground import GROUND, GroundState, ground_message
from msg_tools.messages.images import compressed_image_message
from msg_tools.messages.keep_out import KEEP_OUT, keep_out_markers, keep_out_message
from msg_tools.messages.markers import ground_markers, removed_ground, skeleton_markers
from msg_tools.messages.person_poses import PERSON_POSE, person_pose, person_pose_message
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)
from msg_tools.messages.states import joint_state_message, transforms_message
from msg_tools.messages.urdf import link_frames

# Topics, in the order in which they are published.
TOPICS = {
    'body': PublishedTopic('hmt_msgs/msg/Body', latched=True),
    # Not robot_description, which without a namespace describes the robot.
    'human_description': PublishedTopic('std_msgs/msg/String', latched=True),
    'pose_mixture': PublishedTopic('hmt_msgs/msg/PoseMixture'),
    'likelihood_mixture': PublishedTopic('hmt_msgs/msg/PoseMixture'),
    'person_pose': PublishedTopic(PERSON_POSE),
    'ground': PublishedTopic(GROUND),
    'human_joint_states': PublishedTopic('sensor_msgs/msg/JointState'),
    '/tf': PublishedTopic('tf2_msgs/msg/TFMessage'),
    'markers': PublishedTopic('visualization_msgs/msg/MarkerArray'),
    'overlay/compressed': PublishedTopic('sensor_msgs/msg/CompressedImage'),
    'keep_out': PublishedTopic(KEEP_OUT),
    'pose_forecast': PublishedTopic('hmt_msgs/msg/PoseMixture'),
}
# Bags omit keep_out_markers, which are large and can be computed from keep_out.
TOPICS_OF_NODE = {
    **TOPICS,
    'keep_out_markers': PublishedTopic('visualization_msgs/msg/MarkerArray'),
}

# Name, without prefix, of the frame at the camera with x forward and z up; requires gravity.
UPRIGHT_FRAME = 'camera_upright'
MESSAGES = RosbagsMessages()
# Maximum number of modes drawn on the image, heaviest first.
MAX_OVERLAY_MODES = 3


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """An image, the track in it, and settings of its messages.

    Attributes:
        waiting: image with its stamp and frame.
        tracker: the tracker, updated from the image.
        posterior, likelihood: mixtures over poses, heaviest first.
        parameters: parameters of the node.
        frame_prefix: prefix of the link names.
        starts: whether the body is new, or its lengths have changed since it was published.
        describe: whether to publish the URDF, because the body or the names of its frames are new.
        fixed: frame of mixtures, markers and the pose of the person; None: the frame of the camera.
    """

    waiting: WaitingImage
    tracker: Tracker
    posterior: GaussianMixture
    likelihood: GaussianMixture
    parameters: FilterParameters
    frame_prefix: str
    starts: bool
    describe: bool
    fixed: FixedFrame | None = None


def track_messages(track: TrackedImage, wanted: Callable[[str], bool]) -> Iterator[tuple[str, Any]]:
    """Yields topics and messages of a tracked image, in the order of `TOPICS`.

    Raises:
        MessageError: a mixture is not valid in a message.
    """
    stamp, frame = track.waiting.stamp_ns, track.waiting.frame_id
    tracker, p = track.tracker, track.parameters
    posterior = track.posterior
    body, point = _against_camera(tracker)
    skeleton = body.skeleton
    joints = forward(tracker.estimate.body.skeleton, posterior.means).joints().transpose(2, 0, 1)
    ground = _ground_state(track)
    # Both mixtures are made before anything is published, as either may turn out to be invalid.
    made = {
        'pose_mixture': lambda: _posterior(track, joints),
        'likelihood_mixture': lambda: _likelihood(track),
    }
    mixtures = {topic: make() for topic, make in made.items() if wanted(topic)}
    if track.starts:
        yield 'body', message_of_body(MESSAGES, body, stamp, frame)
    if track.describe:
        yield 'human_description', description_message(MESSAGES, body, frame, track.frame_prefix)
    for topic, mixture in mixtures.items():
        yield topic, pose_mixture_message(MESSAGES, mixture)
    if wanted('person_pose'):
        pose, its_frame = person_pose(tracker.estimate.body, posterior), frame
        if track.fixed is not None:
            pose, its_frame = pose.seen_from(*track.fixed.camera), track.fixed.name
        yield 'person_pose', person_pose_message(MESSAGES, pose, stamp, its_frame)
    if wanted('ground'):
        yield 'ground', ground_message(MESSAGES, ground)
    if wanted('human_joint_states'):
        state = joint_state_message(MESSAGES, body.dof_names, point, stamp, frame)
        yield 'human_joint_states', state
    if p.publish_tf and wanted('/tf'):
        yield '/tf', _link_transforms(track)
    if wanted('markers'):
        names = body.joint_names
        shown, its_frame = joints, frame
        if track.fixed is not None:
            rotation, translation = track.fixed.camera
            shown, its_frame = product(joints, rotation.T) + translation, track.fixed.name
        edges = [(names[a], names[b]) for a, b in skeleton.bones]
        ranks = max(tracker.settings.max_hypotheses, len(posterior))
        array = skeleton_markers(
            MESSAGES, shown, names, edges, posterior.weights, stamp, its_frame, ranks=ranks
        )
        stands = forward(skeleton, point[None]).joints()[..., 0]
        array.markers += ground_markers(MESSAGES, ground, stands, names)
        yield 'markers', array
    if wanted('overlay/compressed'):
        drawn = draw_modes(
            track.waiting.image,
            tracker.camera,
            joints,
            skeleton.bones,
            posterior.weights,
            MAX_OVERLAY_MODES,
        )
        drawn = draw_notes(drawn, notes_of(p))
        yield 'overlay/compressed', compressed_image_message(MESSAGES, drawn, stamp, frame)


def nobody_messages(
    tracker: Tracker, waiting: WaitingImage, p: FilterParameters, wanted: Callable[[str], bool]
) -> Iterator[tuple[str, Any]]:
    """Yields topics and messages at the end of a track, when nobody is, or ever was, in view.

    The overlay shows the image without modes and states the reason; all markers are removed.
    """
    body, stamp = tracker.estimate.body, waiting.stamp_ns
    frame = f'{p.fixed_frame}_optical' if p.publish_in_fixed_frame else waiting.frame_id
    state = TrackState.NOBODY if tracker.estimate.status is Status.NOBODY else TrackState.UNKNOWN
    kinds = {'pose_mixture': MixtureKind.POSTERIOR, 'likelihood_mixture': MixtureKind.LIKELIHOOD}
    for topic, kind in kinds.items():
        if wanted(topic):
            content = PoseMixture.of_body(
                body,
                None,
                kind,
                stamp,
                frame,
                state=state,
                track_id=tracker.track_id,
                existence_probability=tracker.estimate.existence_probability,
                reason=tracker.estimate.reason,
            )
            yield topic, pose_mixture_message(MESSAGES, content)
    if wanted('markers'):
        names, ranks = body.joint_names, tracker.settings.max_hypotheses
        nothing = np.empty((0, len(names), 3))
        markers = skeleton_markers(
            MESSAGES, nothing, names, [], np.empty(0), stamp, frame, ranks=ranks
        )
        markers.markers += removed_ground(MESSAGES, stamp, frame)
        yield 'markers', markers
    if wanted('overlay/compressed'):
        why = tracker.estimate.reason or 'nobody is in view'
        shown = draw_notes(waiting.image, [why, *notes_of(p)])
        yield 'overlay/compressed', compressed_image_message(MESSAGES, shown, stamp, frame)


def notes_of(p: FilterParameters) -> list[str]:
    """Return notes for the overlay on a missing calibration."""
    sigma = p.focal_length_sigma
    return [f'no calibration: distances may be off by {sigma:.0%}'] if sigma else []


def robot_messages(
    robot: RobotOutputs,
    parameters: FilterParameters,
    wanted: Callable[[str], bool],
    silence: float | None = None,
) -> Iterator[Output]:
    """Yields the messages that robots act on.

    Args:
        silence: time since the outputs for the newest image were published, s; None: this call
            publishes them.
    """
    if wanted('keep_out') or wanted('keep_out_markers'):
        content = robot.keep_out(parameters.keep_out_probability, silence)
        if wanted('keep_out'):
            yield Output('keep_out', content.stamp_ns, keep_out_message(MESSAGES, content))
        if wanted('keep_out_markers'):
            yield Output('keep_out_markers', content.stamp_ns, keep_out_markers(MESSAGES, content))
    if silence is None and wanted('pose_forecast'):
        for stamp in robot.due(parameters.forecast_rate, parameters.forecast_horizon):
            forecast = pose_mixture_message(MESSAGES, robot.forecast(stamp))
            yield Output('pose_forecast', stamp, forecast)


def _posterior(track: TrackedImage, joints: Array) -> PoseMixture:
    """Return the posterior for a message; `joints` (K, J, 3) are in the camera frame, m."""
    tracker, posterior = track.tracker, track.posterior
    velocities = tracker.estimate.velocities
    body, frame, positions = tracker.estimate.body, track.waiting.frame_id, joints
    if (fixed := track.fixed) is not None:
        posterior, velocities = fixed.placed(body, posterior, velocities)
        body = body.levelled(np.eye(3))
        frame, positions = fixed.optical, fixed.motion.points(joints)
    return PoseMixture.of_body(
        body,
        posterior,
        MixtureKind.POSTERIOR,
        track.waiting.stamp_ns,
        frame,
        joint_positions=positions,
        log_likelihoods=tracker.estimate.published.log_likelihoods,
        state=_state(tracker),
        track_id=tracker.track_id,
        existence_probability=tracker.estimate.existence_probability,
        cue_probabilities=_in_range(tracker.estimate.validity.shown),
        reason=tracker.estimate.reason,
        identities=tracker.estimate.published.identities,
        velocities=velocities,
    )


def _likelihood(track: TrackedImage) -> PoseMixture:
    """Return the undiscounted likelihood for a message, with its error model."""
    tracker, likelihood, frame = track.tracker, track.likelihood, track.waiting.frame_id
    # The error of the focal length is the same in all images, like the error of the shape.
    focal = depth_covariances(track.posterior.means[:1], track.parameters.focal_length_sigma)[0]
    body, found = tracker.estimate.body, tracker.estimate.likelihood
    shape = found.shape_covariance + focal
    if (fixed := track.fixed) is not None:
        likelihood, _ = fixed.placed(body, likelihood)
        at_best = GaussianMixture(np.ones(1), track.posterior.means[:1], shape[None])
        shape, frame = fixed.placed(body, at_best)[0].covariances[0], fixed.optical
        body = body.levelled(np.eye(3))
    return PoseMixture.of_body(
        body,
        likelihood,
        MixtureKind.LIKELIHOOD,
        track.waiting.stamp_ns,
        frame,
        state=_state(tracker),
        track_id=tracker.track_id,
        existence_probability=tracker.estimate.existence_probability,
        log_likelihoods=found.values,
        error_share=found.errors.independent,
        error_time=found.errors.time,
        shape_covariance=shape,
        reason=tracker.estimate.reason,
        identities=found.identities,
        posterior_weights=found.posterior_weights,
        ancestry=found.origins,
        ancestry_stamp_ns=found.ancestry_stamp or 0,
        ancestry_ids=found.ancestors,
    )


def _against_camera(tracker: Tracker) -> tuple[Body, Array]:
    """Return the body and its point estimate (d,), with root angles relative to the camera."""
    body, point = tracker.estimate.body, tracker.estimate.point_estimate
    upright = body.levelled(np.eye(3))
    return upright, point if upright is body else turned(body, point[None], upright)[0]


def _state(tracker: Tracker) -> TrackState:
    return TrackState.LOST if tracker.estimate.status is Status.LOST else TrackState.TRACKING


def _ground_state(track: TrackedImage) -> GroundState:
    """Return gravity and floor for a message."""
    ground = track.tracker.estimate.ground
    return GroundState(
        track.waiting.stamp_ns,
        track.waiting.frame_id,
        ground.up,
        ground.up_sigma,
        ground.height,
        math.nan if ground.height is None else ground.height_sigma,
        _in_range(track.tracker.estimate.contacts),
    )


def _in_range(probabilities: Mapping[str, float]) -> dict[str, float]:
    """Clip probabilities to the range 0 to 1, which rounding may exceed."""
    return {name: min(max(float(p), 0.0), 1.0) for name, p in probabilities.items()}


def _link_transforms(track: TrackedImage) -> Any:
    """Return the transforms of the URDF links at the point estimate, and of frames with z up."""
    tracker, camera, prefix = track.tracker, track.waiting.frame_id, track.frame_prefix
    links = zip(*links_of(*_against_camera(tracker)), strict=True)
    frames = [(camera, f'{prefix}{name}', *place) for name, *place in links]
    if tracker.estimate.vertical is not None:
        frames.append(
            (camera, f'{prefix}{UPRIGHT_FRAME}', upright(tracker.estimate.vertical), np.zeros(3))
        )
    if track.fixed is not None:
        frames.append((track.fixed.name, track.fixed.optical, OPTICAL_TO_BODY, np.zeros(3)))
    parents, children, rotations, origins = zip(*frames, strict=True)
    stamp = track.waiting.stamp_ns
    return transforms_message(MESSAGES, parents, children, rotations, origins, stamp)


def links_of(body: Body, pose: Array) -> tuple[list[str], Array, Array]:
    """Return names (L), rotations (L, 3, 3) and origins (L, 3), m, of the URDF links in a pose."""
    return link_frames(body.skeleton, forward(body.skeleton, pose[None]), pose, 0)
