"""Messages about a tracked image.

`TOPICS` holds names and types; the functions make the messages from arrays. A message depends on
the track and the image alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body, Camera
from hmt_ros.body.kinematics import forward
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array, Index
from hmt_ros.inference.error_model import CueErrors
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.fixed_frame import FROM_OPTICAL, FixedFrame, upright
from hmt_ros.sessions.overlay import draw_modes
from hmt_ros.sessions.robot_outputs import RobotOutputs
from hmt_ros.sessions.session import PublishedTopic
from hmt_ros.tracking.ground import Ground
from msg_tools import MessageFactory
from msg_tools.messages.bodies import description_message, message_of_body
from msg_tools.messages.ground import GROUND, GroundState, ground_message
from msg_tools.messages.images import compressed_image_message
from msg_tools.messages.keep_out import KEEP_OUT, keep_out_markers, keep_out_message
from msg_tools.messages.markers import ground_markers, removed_ground, skeleton_markers
from msg_tools.messages.people import PERSON_POSE, person_pose, person_pose_message
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)
from msg_tools.messages.states import joint_state_message, transforms_message
from msg_tools.messages.urdf import link_frames

# In the order in which they are published.
TOPICS = {
    'body': PublishedTopic('hmt_msgs/msg/Body', latched=True),
    # Never robot_description: without a namespace that would be the robot's own.
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
# Bags have none: it is large, and follows from keep_out.
TOPICS_OF_NODE = {
    **TOPICS,
    'keep_out_markers': PublishedTopic('visualization_msgs/msg/MarkerArray'),
}

# Frame at the camera with x forward and z up, where gravity is known; a prefix stands before it.
UPRIGHT = 'camera_upright'


@dataclass(frozen=True, eq=False)
class TrackedImage:
    """An image, and the track in it.

    Attributes:
        image: (H, W, 3) BGR.
        stamp_ns, frame_id: of the image.
        body, camera: of the track.
        posterior, likelihood: mixtures over poses, heaviest first.
        log_likelihoods: (K,) of the image at the means of the posterior.
        likelihood_values: (L,) the same at the means of the likelihood.
        likelihood_errors: how the errors of the likelihood last, which is undiscounted.
        shape_covariance: (d, d) of what poses of all images err by alike, see `Tracker`.
        point: (d,) the point estimate, for those who want one pose.
        ground: gravity and the floor, as far as they are known.
        contacts: probabilities that the feet stand on the floor, by name.
        starts: whether the body is a new one, with other lengths than the image before.
        state: of the track.
        track_id: number of the track.
        existence_probability: that a person is in view; NaN: unknown.
        cue_probabilities: that each cue of the images shows the person, by its name, and that the
            track has the person; empty: unknown.
        identities: (K,) of the components of the posterior.
        velocities: (K, d) of the components of the posterior, per second; None: unknown.
        up: (3,) unit vector against gravity in the camera frame; None: it is not known, at most
            guessed.
        fixed: frame that mixtures, markers and the pose of the person are published in; None: the
            frame of the camera.
    """

    image: NDArray[np.uint8]
    stamp_ns: int
    frame_id: str
    body: Body
    camera: Camera
    posterior: GaussianMixture
    likelihood: GaussianMixture
    log_likelihoods: Array
    likelihood_values: Array
    likelihood_errors: CueErrors
    shape_covariance: Array
    point: Array
    ground: Ground
    contacts: Mapping[str, float]
    starts: bool
    state: TrackState = TrackState.UNKNOWN
    track_id: int = 0
    existence_probability: float = math.nan
    cue_probabilities: Mapping[str, float] = field(default_factory=dict)
    identities: Index | None = None
    velocities: Array | None = None
    up: Array | None = None
    fixed: FixedFrame | None = None


@dataclass(frozen=True)
class Presentation:
    """How a track is shown.

    Attributes:
        max_hypotheses: maximum number of modes of a track.
        overlay_modes: heaviest modes that are drawn on the image; 0: no overlay.
        publish_tf: whether there are transforms.
        frame_prefix: of the names of the frames of the links.
        describe: whether the URDF is due: a new body, or other names of its frames.
    """

    max_hypotheses: int
    overlay_modes: int
    publish_tf: bool
    frame_prefix: str
    describe: bool


def track_messages(
    messages: MessageFactory,
    track: TrackedImage,
    presentation: Presentation,
    wanted: Callable[[str], bool],
    publish: Callable[[str, Any], None],
) -> None:
    """Makes the messages of a tracked image.

    Args:
        messages: factory.
        track: the image and its track.
        presentation: how it is shown.
        wanted: whether a topic is to be made; mixtures come first, pictures last.
        publish: takes the topic and the message, one after the other.

    Raises:
        MessageError: a mixture that a message must not have.
    """
    stamp, frame = track.stamp_ns, track.frame_id
    skeleton = track.body.skeleton
    frames = forward(skeleton, track.posterior.means)
    joints = frames.joints().transpose(2, 0, 1)
    ground = _ground_state(track)
    # Both are made before anything is published: either may be one that a message must not have.
    made = {
        'pose_mixture': lambda: _posterior(track, joints),
        'likelihood_mixture': lambda: _likelihood(track),
    }
    mixtures = {topic: make() for topic, make in made.items() if wanted(topic)}
    if track.starts:
        publish('body', message_of_body(messages, track.body, stamp, frame))
    if presentation.describe:
        prefix = presentation.frame_prefix
        publish('human_description', description_message(messages, track.body, frame, prefix))
    for topic, mixture in mixtures.items():
        publish(topic, pose_mixture_message(messages, mixture))
    if wanted('person_pose'):
        pose, its_frame = person_pose(track.body, track.posterior), frame
        if track.fixed is not None:
            pose, its_frame = pose.seen_from(*track.fixed.camera), track.fixed.name
        publish('person_pose', person_pose_message(messages, pose, stamp, its_frame))
    if wanted('ground'):
        publish('ground', ground_message(messages, ground))
    if wanted('human_joint_states'):
        names = track.body.dof_names
        publish(
            'human_joint_states', joint_state_message(messages, names, track.point, stamp, frame)
        )
    if presentation.publish_tf and wanted('/tf'):
        publish('/tf', _link_transforms(messages, track, presentation.frame_prefix))
    if wanted('markers'):
        names = track.body.joint_names
        shown, its_frame = joints, frame
        if track.fixed is not None:
            rotation, translation = track.fixed.camera
            shown, its_frame = joints @ rotation.T + translation, track.fixed.name
        array = skeleton_markers(
            messages,
            shown,
            names,
            [(names[a], names[b]) for a, b in skeleton.bones],
            track.posterior.weights,
            stamp,
            its_frame,
            ranks=max(presentation.max_hypotheses, len(track.posterior)),
        )
        stands = forward(skeleton, track.point[None]).joints()[..., 0]
        array.markers += ground_markers(messages, ground, stands, names)
        publish('markers', array)
    if presentation.overlay_modes and wanted('overlay/compressed'):
        drawn = draw_modes(
            track.image,
            track.camera,
            joints,
            skeleton.bones,
            track.posterior.weights,
            presentation.overlay_modes,
        )
        publish('overlay/compressed', compressed_image_message(messages, drawn, stamp, frame))


def nobody_messages(
    messages: MessageFactory,
    body: Body,
    track_id: int,
    existence_probability: float,
    ranks: int,
    stamp_ns: int,
    frame_id: str,
    image: NDArray[np.uint8] | None,
    wanted: Callable[[str], bool],
    publish: Callable[[str, Any], None],
) -> None:
    """Makes the messages of an image that ends a track: nobody is in view any more.

    Args:
        messages: factory.
        body: of the track.
        track_id: its number.
        existence_probability: that a person is in view.
        ranks: maximum number of modes of the track, whose markers are removed.
        stamp_ns, frame_id: of the image.
        image: (H, W, 3) BGR, shown without modes; None: no overlay.
        wanted, publish: as for `track_messages`.
    """
    kinds = {'pose_mixture': MixtureKind.POSTERIOR, 'likelihood_mixture': MixtureKind.LIKELIHOOD}
    for topic, kind in kinds.items():
        if wanted(topic):
            content = PoseMixture.of_body(
                body, None, kind, stamp_ns, frame_id, state=TrackState.NOBODY, track_id=track_id,
                existence_probability=existence_probability,
            )  # fmt: skip
            publish(topic, pose_mixture_message(messages, content))
    if wanted('markers'):
        names = body.joint_names
        nothing = np.empty((0, len(names), 3))
        markers = skeleton_markers(
            messages, nothing, names, [], np.empty(0), stamp_ns, frame_id, ranks=ranks
        )
        markers.markers += removed_ground(messages, stamp_ns, frame_id)
        publish('markers', markers)
    if image is not None and wanted('overlay/compressed'):
        picture = compressed_image_message(messages, image, stamp_ns, frame_id)
        publish('overlay/compressed', picture)


def robot_messages(
    messages: MessageFactory,
    robot: RobotOutputs,
    parameters: FilterParameters,
    wanted: Callable[[str], bool],
    publish: Callable[[str, int, Any], None],
    silence: float | None = None,
) -> None:
    """Makes the messages that robots act on.

    Args:
        messages: factory.
        robot: knows the newest image.
        parameters: how.
        wanted: whether a topic is to be made.
        publish: takes topic, stamp and message, one after the other.
        silence: time since the newest image was answered, s, where none comes any more; None: it
            is being answered.
    """
    if wanted('keep_out') or wanted('keep_out_markers'):
        content = robot.keep_out(parameters.keep_out_probability, silence)
        if wanted('keep_out'):
            publish('keep_out', content.stamp_ns, keep_out_message(messages, content))
        if wanted('keep_out_markers'):
            publish('keep_out_markers', content.stamp_ns, keep_out_markers(messages, content))
    if silence is None and wanted('pose_forecast'):
        for stamp in robot.due(parameters.forecast_rate, parameters.forecast_horizon):
            made = pose_mixture_message(messages, robot.forecast(stamp))
            publish('pose_forecast', stamp, made)


def _posterior(track: TrackedImage, joints: Array) -> PoseMixture:
    """The posterior, with joints (K, J, 3) in the camera frame."""
    posterior, velocities = track.posterior, track.velocities
    frame, positions = track.frame_id, joints
    if (fixed := track.fixed) is not None:
        posterior, velocities = fixed.placed(track.body, posterior, velocities)
        frame, positions = fixed.optical, fixed.motion.points(joints)
    return PoseMixture.of_body(
        track.body,
        posterior,
        MixtureKind.POSTERIOR,
        track.stamp_ns,
        frame,
        joint_positions=positions,
        log_likelihoods=track.log_likelihoods,
        state=track.state,
        track_id=track.track_id,
        existence_probability=track.existence_probability,
        cue_probabilities=_in_range(track.cue_probabilities),
        identities=track.identities,
        velocities=velocities,
    )


def _likelihood(track: TrackedImage) -> PoseMixture:
    likelihood, frame, shape = track.likelihood, track.frame_id, track.shape_covariance
    if (fixed := track.fixed) is not None:
        likelihood, _ = fixed.placed(track.body, likelihood)
        at_best = GaussianMixture(np.ones(1), track.posterior.means[:1], shape[None])
        shape, frame = fixed.placed(track.body, at_best)[0].covariances[0], fixed.optical
    return PoseMixture.of_body(
        track.body,
        likelihood,
        MixtureKind.LIKELIHOOD,
        track.stamp_ns,
        frame,
        state=track.state,
        track_id=track.track_id,
        existence_probability=track.existence_probability,
        log_likelihoods=track.likelihood_values,
        error_share=track.likelihood_errors.independent,
        error_time=track.likelihood_errors.time,
        shape_covariance=shape,
    )


def _ground_state(track: TrackedImage) -> GroundState:
    """What is known of gravity and of the floor, as a message holds it."""
    ground = track.ground
    return GroundState(
        track.stamp_ns,
        track.frame_id,
        ground.up,
        ground.up_sigma,
        ground.height,
        math.nan if ground.height is None else ground.height_sigma,
        _in_range(track.contacts),
    )


def _in_range(probabilities: Mapping[str, float]) -> dict[str, float]:
    """Probabilities by name, which rounding may have taken a little out of their range."""
    return {name: min(max(float(p), 0.0), 1.0) for name, p in probabilities.items()}


def _link_transforms(messages: MessageFactory, track: TrackedImage, prefix: str) -> Any:
    """Every link of the URDF in the point estimate, and frames with z up, from the camera."""
    names, rotations, origins = links_of(track.body, track.point)
    parents = [track.frame_id] * len(names)
    children = [f'{prefix}{name}' for name in names]
    if track.up is not None:
        parents, children = [*parents, track.frame_id], [*children, f'{prefix}{UPRIGHT}']
        rotations = np.concatenate([rotations, upright(track.up)[None]])
        origins = np.concatenate([origins, np.zeros((1, 3))])
    if track.fixed is not None:
        parents, children = [*parents, track.fixed.name], [*children, track.fixed.optical]
        rotations = np.concatenate([rotations, FROM_OPTICAL[None]])
        origins = np.concatenate([origins, np.zeros((1, 3))])
    return transforms_message(messages, parents, children, rotations, origins, track.stamp_ns)


def links_of(body: Body, pose: Array) -> tuple[list[str], Array, Array]:
    """Names (L), rotations (L, 3, 3) and origins (L, 3), m, of the links of the URDF in a pose."""
    return link_frames(body.skeleton, forward(body.skeleton, pose[None]), pose, 0)
