"""The track of one person in front of a camera: images in, mixtures over poses out.

If several people are tracked, each has topics in `humans/bodies/<id>/` (REP 155), and link frames
that begin with `body_<id>/`; for a single person there are no such prefixes. When the person is no
longer in view, one mixture of each kind without components is published, with markers that remove
the earlier markers. Only outputs for robots, which are published for every image, follow until a
new track starts.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Mask
from hmt_ros.sessions.camera_frames import CameraFrames
from hmt_ros.sessions.camera_session import WaitingImage
from hmt_ros.sessions.fixed_frame import FixedFrame
from hmt_ros.sessions.focal_length import with_depth_error
from hmt_ros.sessions.handled import HandlingLog, Output
from hmt_ros.sessions.robot_outputs import LastSeen, RobotOutputs
from hmt_ros.sessions.seen_images import SeenImages
from hmt_ros.sessions.track_messages import (
    TOPICS_OF_NODE,
    TrackedImage,
    nobody_messages,
    robot_messages,
    track_messages,
)
from hmt_ros.sessions.track_reports import TrackCondition, report_change
from hmt_ros.sessions.track_start import TrackStart
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.tracking import PosePrediction, Status, Tracker
from hmt_ros.tracking.ground import KnownGround
from msg_tools.files.error_line import error_line
from msg_tools.messages.keep_out import KeepOutState

BODIES = 'humans/bodies'
# Maximum change of a segment length without a new body message, m.
MAX_LENGTH_CHANGE = 0.005
_STATES = {
    Status.WAITING: KeepOutState.UNKNOWN,
    Status.TRACKING: KeepOutState.TRACKING,
    Status.LOST: KeepOutState.LOST,
    Status.NOBODY: KeepOutState.NOBODY,
}


def topic_of(person: str, topic: str) -> str:
    """Return a topic with the prefix of a person; no prefix for absolute topics or person ''."""
    return f'{BODIES}/{person}/{topic}' if person and not topic.startswith('/') else topic


def person_of(topic: str) -> str:
    """Return the person that a topic belongs to; '' for a shared topic."""
    name = topic.removeprefix(f'{BODIES}/')
    return '' if name == topic else name.partition('/')[0]


@dataclass(eq=False)
class Shared:
    """Objects that the tracks of a session share.

    Attributes:
        frames: frames that transforms relate to the camera.
        log: log of the session.
        publish: function that publishes a message, called with topic, stamp in ns, and message.
        wanted: function that returns whether a topic needs to be published.
        answering: lock on the outputs for robots, so that the watchdog never publishes after the
            outputs for a newer image.
        answered: number of images for which outputs for robots were published.
        seen_images: store of evidence for a smoother, if one person is tracked in the camera frame.
    """

    frames: CameraFrames
    log: HandlingLog
    publish: Callable[[str, int, Any], None]
    wanted: Callable[[str], bool]
    answering: threading.Lock = field(default_factory=threading.Lock)
    answered: int = 0
    seen_images: SeenImages = field(default_factory=SeenImages)


class Seen(NamedTuple):
    """Evidence on a person that accompanies an image; see `Tracker.step`.

    Attributes:
        keypoints: detected keypoints of the person; None: the detector has given no result.
        prediction: prediction of the pose, or `Status.NOBODY`; None without a prediction.
        others: (H, W) mask of the pixels that other people cover; None: no such pixels.
    """

    keypoints: Keypoints | None
    prediction: PosePrediction | Status | None = None
    others: Mask | None = None


class Track:
    """Tracks one person; only `stale` is thread-safe.

    Args:
        person: identity of the person, used in names of topics and frames; '' for a single person.
        parameters: parameters of the node; `follow` replaces them.
        background: background that several tracks share and that is learned elsewhere; None: the
            track learns its own background.

    Attributes:
        person: identity of the person.
        start: data that the track starts from.
        tracker: the tracker; None before the first image after a restart.
        body: body that was published last; None if no body was published since the restart.
        weights: weights of the present mixture; empty without a mixture.
        robot: outputs for robots; may be read by any thread.
    """

    def __init__(
        self,
        person: str,
        parameters: FilterParameters,
        start: TrackStart,
        shared: Shared,
        background: BackgroundModel | None = None,
    ) -> None:
        self.person = person
        self.tracker: Tracker | None = None
        self.robot = RobotOutputs()
        self._parameters, self._shared, self._background = parameters, shared, background
        self._last_id = 0
        self._described: tuple[str, str] | None = None
        self.restart(start)
        for topic in TOPICS_OF_NODE if person else ():
            # Creates the publishers early, as messages right after their creation would be lost.
            self._wants(topic)

    def restart(self, start: TrackStart) -> None:
        """Drops the track; a new one starts with the images that follow."""
        self._last_id, self.start = self.track_id, start
        self.tracker = None
        self.body: Body | None = None
        self.weights = np.empty(0)
        # Attribute `turn` of the next `FixedFrame`, rad.
        self._turn = 0.0

    @property
    def track_id(self) -> int:
        """Number of the present or last track; 0 before the first track."""
        return self._last_id if self.tracker is None else self.tracker.track_id

    @property
    def status(self) -> Status:
        """Status of the tracker."""
        return Status.WAITING if self.tracker is None else self.tracker.estimate.status

    @property
    def begun(self) -> bool:
        """Whether there is a track, possibly a lost one."""
        return self.status in (Status.TRACKING, Status.LOST)

    def follow(
        self, waiting: WaitingImage, camera: Camera, seen: Seen, parameters: FilterParameters
    ) -> bool | None:
        """Tracks the person in an image, and publishes the results.

        Returns:
            True if mixtures were published, False if that was impossible; None without a track.
        """
        self._parameters = parameters
        log, stamp, answered = self._shared.log, waiting.stamp_ns, False
        before = TrackCondition.of(self.tracker)
        starts = before.status is Status.WAITING
        try:
            tracker = self._placed_tracker(camera)
            posterior, likelihood = tracker.step(
                waiting.image,
                stamp,
                seen.keypoints,
                seen.prediction if isinstance(seen.prediction, PosePrediction) else None,
                waiting.mask,
                nobody_predicted=seen.prediction is Status.NOBODY,
                others=seen.others,
                depth=waiting.depth,
            )
            report_change(log, before, tracker, self.start.initial, stamp)
            if waiting.depth is not None and not tracker.estimate.validity.is_trusted('depth'):
                log.note(
                    'depth of something else',
                    f'depth of {stamp} ns does not show the person where the image does: depth '
                    'images are not used until they do; wanted depth of the same time, registered '
                    'to the colour camera',
                )
            published = None
            kept = self._shared.seen_images
            if kept.wanted and not (self.person or parameters.publish_in_fixed_frame):
                kept.add(stamp, tracker.estimate.shown)
            if posterior is not None and likelihood is not None:
                posterior = with_depth_error(posterior, parameters.focal_length_sigma)
                published = self._publish(tracker, waiting, posterior, likelihood)
            elif len(self.weights):
                self._publish_nobody(tracker, waiting)
            if not starts and tracker.estimate.status is Status.WAITING:
                # The track may have followed something other than a person.
                self.robot.forget()
            answered = True
            self._answer_robot(waiting, tracker, posterior)
        except (ValueError, ArithmeticError) as error:
            text = error_line(error)
            if not answered:
                self._answer_robot(waiting)
            if not starts:
                log.fault('estimate', f'image of {stamp} ns can not be tracked: {text}')
                return False
            # With the same start, the next image would fail in the same way.
            log.fault('start', f'no track starts at the image of {stamp} ns: {text}')
            self.restart(replace(self.start, background=None, initial=None, box=None))
            return False
        return published

    def stale(self, silence: float) -> Iterator[Output]:
        """Yields messages that tell robots that the estimate is old. Thread-safe.

        Args:
            silence: time since the outputs for the newest image were published, s.
        """
        for made in robot_messages(self.robot, self._parameters, self._wants, silence):
            yield replace(made, topic=topic_of(self.person, made.topic))

    def _placed_tracker(self, camera: Camera) -> Tracker:
        """Return the tracker, with gravity and pose of the camera set for the present image.

        Raises:
            ValueError: no tracker can start.
        """
        frames, tracker = self._shared.frames, self.tracker
        if tracker is None:
            ground = frames.known_ground(self.start.parameters.known_ground)
            tracker = self.tracker = self.start.tracker(camera, ground, self._background)
            tracker.track_id = self._last_id
        elif frames.newest:
            seen = frames.known_ground(KnownGround())
            assert seen.up is not None
            tracker.set_gravity(seen.up, seen.camera_height, seen.up_sigma)
        if (pose := frames.pose) is not None:
            tracker.set_camera(pose.translation, pose.rotation)
        return tracker

    # Outputs.

    def _wants(self, topic: str) -> bool:
        return self._shared.wanted(topic_of(self.person, topic))

    def _put_out(self, topic: str, stamp: int, message: Any) -> None:
        self._shared.publish(topic_of(self.person, topic), stamp, message)

    def _fixed_frame(self) -> FixedFrame | None:
        """Return the fixed frame of the messages; None if not requested, or its pose is unknown."""
        p, pose = self._parameters, self._shared.frames.pose
        if not p.publish_in_fixed_frame or pose is None:
            return None
        return FixedFrame(p.fixed_frame, pose, self._turn)

    def _publish(
        self,
        tracker: Tracker,
        waiting: WaitingImage,
        posterior: GaussianMixture,
        likelihood: GaussianMixture,
    ) -> bool:
        p, fixed = self._parameters, self._fixed_frame()
        starts = self.body is None or not resembles(
            tracker.estimate.body, self.body, MAX_LENGTH_CHANGE
        )
        if starts:
            self.body = tracker.estimate.body
        if fixed is not None:
            self._turn = fixed.turn_of(tracker.estimate.body, posterior.means[0])
        elif p.publish_in_fixed_frame:
            self._shared.log.fault(
                'no pose of the camera',
                f'the image of {waiting.stamp_ns} ns is tracked, but not published: its place '
                f'in fixed_frame {p.fixed_frame!r} is unknown',
            )
            return False
        prefix = f'{p.frame_prefix}body_{self.person}/' if self.person else p.frame_prefix
        frames = (waiting.frame_id, prefix)
        track = TrackedImage(
            waiting,
            tracker,
            posterior,
            likelihood,
            p,
            frame_prefix=prefix,
            starts=starts,
            describe=starts or self._described != frames,
            fixed=fixed,
        )
        for topic, message in track_messages(track, self._wants):
            self._put_out(topic, waiting.stamp_ns, message)
        self._described = frames
        self.weights = posterior.weights
        return True

    def _publish_nobody(self, tracker: Tracker, waiting: WaitingImage) -> None:
        """Publishes the end of a track whose person is no longer in view."""
        for topic, message in nobody_messages(tracker, waiting, self._parameters, self._wants):
            self._put_out(topic, waiting.stamp_ns, message)
        self.weights = np.empty(0)

    def _answer_robot(
        self,
        waiting: WaitingImage,
        tracker: Tracker | None = None,
        posterior: GaussianMixture | None = None,
    ) -> None:
        """Publishes the outputs for robots.

        Args:
            tracker: the tracker after the image; None if the image could not be tracked.
            posterior: posterior at the image; None without a track.
        """
        p, fixed = self._parameters, self._fixed_frame()
        placed = fixed is not None or not p.publish_in_fixed_frame
        state, seen, existence = KeepOutState.UNKNOWN, None, math.nan
        reason = 'the image can not be tracked'
        if tracker is not None:
            state, existence = (
                _STATES[tracker.estimate.status],
                tracker.estimate.existence_probability,
            )
            reason = tracker.estimate.reason
            if tracker.estimate.status is Status.WAITING and self.start.initial is not None:
                reason = f'waiting for {self.start.wants(())}'
            if state is KeepOutState.NOBODY and not tracker.estimate.nobody_shown:
                # An earlier image showed that nobody is there; this one gives no evidence.
                state = KeepOutState.UNKNOWN
            elif state is KeepOutState.TRACKING:
                if placed and posterior is not None and not tracker.estimate.foreseen:
                    seen = LastSeen(
                        waiting.stamp_ns,
                        waiting.frame_id,
                        tracker.estimate.body,
                        posterior,
                        tracker.estimate.forecaster,
                        fixed,
                        p.keep_out_probability,
                        p.focal_length_sigma,
                    )
                else:
                    state = KeepOutState.LOST
        number = self._last_id if tracker is None else tracker.track_id
        frame = p.fixed_frame if p.publish_in_fixed_frame else waiting.frame_id
        with self._shared.answering:
            self.robot.update(waiting.stamp_ns, frame, state, number, existence, seen, reason)
            for made in robot_messages(self.robot, p, self._wants):
                self._put_out(made.topic, made.stamp_ns, made.message)
            self._shared.answered += 1


def resembles(body: Body, other: Body, tolerance: float) -> bool:
    """Whether two bodies have the same model, and lengths that agree within a tolerance, m."""
    if (body.name, body.dof_names) != (other.name, other.dof_names):
        return False
    change = np.abs(body.skeleton.lengths - other.skeleton.lengths)
    return bool(change.max(initial=0.0) <= tolerance)
