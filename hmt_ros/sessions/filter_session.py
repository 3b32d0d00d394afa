"""The filter behind its topics.

The node and offline replay give their messages to a `FilterSession`; the same messages in the same
order give the same bytes. The rules, besides those of `TrackingSession`:

- An image that is not younger than the one before is skipped, or starts the track anew with
  `reset_on_time_jump`.
- An image waits for the inputs that are used (`image_inputs`); keypoints without names, and
  mixtures without components, say that nobody was seen.
- When the person is no longer in view one mixture without components of either kind goes out, with
  markers that remove those before, and then nothing until a new track starts.
- What can not be used is skipped. The first fault of each kind is logged; all are counted.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Mask
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE, WaitingImage
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.filter_state import FilterState
from hmt_ros.sessions.fixed_frame import FixedFrame
from hmt_ros.sessions.handled import Fault, Output
from hmt_ros.sessions.image_inputs import (
    COMPRESSED_MASK,
    DEPTH,
    INPUTS,
    KEYPOINTS,
    KEYPOINTS_3D,
    KEYPOINTS_INPUT,
    MASK,
    PREDICTION,
    PREDICTION_INPUT,
    ImageInput,
)
from hmt_ros.sessions.keypoint_inputs import KeypointReader, keypoints_input
from hmt_ros.sessions.robot_outputs import LastSeen, RobotOutputs
from hmt_ros.sessions.session import everything
from hmt_ros.sessions.track_messages import (
    TOPICS_OF_NODE,
    Presentation,
    TrackedImage,
    nobody_messages,
    robot_messages,
    track_messages,
)
from hmt_ros.sessions.track_reports import TrackCondition, report_change
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.tracking import PosePrediction, Status, Tracker
from hmt_ros.tracking.ground import KnownGround
from msg_tools.files.error_line import error_line
from msg_tools.messages.bodies import body_of
from msg_tools.messages.cdr import serialise
from msg_tools.messages.keep_out import KeepOutState
from msg_tools.messages.pose_mixtures import TrackState, pose_mixture_of

__all__ = [
    'CAMERA_INFO',
    'COMPRESSED_MASK',
    'DEPTH',
    'IMAGE',
    'KEYPOINTS',
    'KEYPOINTS_3D',
    'MASK',
    'PREDICTION',
    'FilterSession',
    'FilterState',
]

# Change of a length above which a body is described anew, m.
RESHAPED = 0.005
_STATES = {
    Status.WAITING: KeepOutState.UNKNOWN,
    Status.TRACKING: KeepOutState.TRACKING,
    Status.LOST: KeepOutState.LOST,
    Status.NOBODY: KeepOutState.NOBODY,
}


class FilterSession(TrackingSession[FilterParameters, FilterState]):
    """Tracks one person before one camera; see `TrackingSession` for arguments and attributes.

    Attributes:
        robot: what a robot acts on; may be read by any thread.
    """

    TOPICS = TOPICS_OF_NODE
    ESTIMATE = 'the track'
    CHECKED = ('subject_file', 'background_file', 'body_model', 'lifter')

    def __init__(
        self,
        parameters: FilterParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        super().__init__(parameters, publish, wanted)
        self._tracker: Tracker | None = None
        self._tracks, self._turn = 0, 0.0
        self._shown_body: Body | None = None
        self._shown_frames: tuple[str, str] | None = None
        self._keypoints = KeypointReader(parameters.source, self._log)
        # Of an image that was left out since the last estimate.
        self._late_prediction: PosePrediction | None = None
        self.robot = RobotOutputs()
        # What a watchdog says never follows the answer to a newer image.
        self._telling = threading.Lock()
        self.state = self._present_state()

    @classmethod
    def inputs_of(cls, parameters: FilterParameters) -> tuple[ImageInput, ...]:
        """See `CameraSession`."""
        own = keypoints_input(parameters.source)
        return tuple(own if row is KEYPOINTS_INPUT else row for row in INPUTS)

    # Inputs.

    def _forget(self) -> None:
        if self._tracker is not None:
            self._tracks = self._tracker.track_id
        self._tracker = None
        self._shown_body, self._turn = None, 0.0

    def _forget_inputs(self, stamp: int) -> None:
        super()._forget_inputs(stamp)
        # Where time begins again, so do the numbers of the tracks.
        self._tracker, self._tracks = None, 0
        self.robot.forget()
        self._keypoints.forget()
        self._late_prediction = None

    def _read_input(self, row: ImageInput, message: Any, stamp: int) -> Any:
        if row.name == KEYPOINTS:
            p = self.parameters
            return self._keypoints.read(
                message, stamp, p, self.start.body, self._camera, p.keypoint_sigma_px
            )
        if row is PREDICTION_INPUT:
            return self._prediction_in(message)
        return super()._read_input(row, message, stamp)

    def _prediction_in(self, message: Any) -> PosePrediction | Status | None:
        """The mixture and its body, see `body_of`; `NOBODY`: was seen; None: it says nothing.

        Raises:
            ValueError: it can not be used; one line.
        """
        if len(message.components) == 0:
            # A predictor that leaves the image to the track has seen neither somebody nor nobody.
            return None if message.state == TrackState.TRACKING else Status.NOBODY
        try:
            content = pose_mixture_of(message)
            return PosePrediction(content.mixture, body_of(content, self.start.body))
        except ValueError as error:
            raise ValueError(f'pose_prediction: {error}') from error

    def _leave_out(self, stamp: int) -> None:
        # A person moves little until the next image: the prediction is a hypothesis there, too.
        found = self._inputs[PREDICTION].take(stamp)
        if isinstance(found, PosePrediction):
            self._late_prediction = found

    def _prediction_of(self, waiting: WaitingImage) -> PosePrediction | Status | None:
        """What was predicted from an image or, without that, from one left out before it."""
        found: PosePrediction | Status | None = waiting.content(PREDICTION)
        late, self._late_prediction = self._late_prediction, None
        return late if found is None else found

    # Outputs.

    def _estimate(self, waiting: WaitingImage, camera: Camera) -> None:
        p = self.parameters
        keypoints = self._keypoints.at_joints(
            waiting.content(KEYPOINTS), waiting.content(KEYPOINTS_3D), self.start.body,
            p.keypoint_scheme, waiting.stamp_ns,
        )  # fmt: skip
        prediction = self._prediction_of(waiting) if p.use_predictions else None
        self._follow(waiting, camera, keypoints, prediction)

    def _new_tracker(self, camera: Camera) -> Tracker:
        return self.start.tracker(camera, self._known_ground())

    def _known_ground(self) -> KnownGround:
        return self.frames.known_ground(self.start.parameters.known_ground)

    def _follow(
        self,
        waiting: WaitingImage,
        camera: Camera,
        keypoints: Keypoints | None,
        prediction: PosePrediction | Status | None,
        others: Mask | None = None,
    ) -> None:
        """Takes an image with its inputs; see `Tracker.step`."""
        stamp = waiting.stamp_ns
        before, answered = TrackCondition.of(self._tracker), False
        starts = before.status is Status.WAITING
        try:
            self._look_at_frames(waiting)
            if self._tracker is None:
                self._tracker = self._new_tracker(camera)
                self._tracker.track_id = self._tracks
            elif self.frames.newest:
                seen = self.frames.known_ground(KnownGround())
                assert seen.up is not None
                self._tracker.set_gravity(seen.up, seen.camera_height)
            if (pose := self.frames.pose) is not None:
                self._tracker.set_camera(pose.translation, pose.rotation)
            posterior, likelihood = self._tracker.step(
                waiting.image,
                stamp,
                keypoints,
                prediction if isinstance(prediction, PosePrediction) else None,
                waiting.mask,
                nobody_predicted=prediction is Status.NOBODY,
                others=others,
                depth=waiting.depth,
            )
            report_change(self._log, before, self._tracker, self.start.initial, stamp)
            if waiting.depth is not None and not self._tracker.validity.believes('depth'):
                self._log.note(
                    Fault.DEPTH_ELSEWHERE,
                    f'depth of {stamp} ns does not show the person where the image does: depth '
                    'images are not used until they do; wanted depth of the same time, registered '
                    'to the colour camera',
                )
            if posterior is not None and likelihood is not None:
                self._publish_track(self._tracker, waiting, posterior, likelihood)
            elif len(self._weights):
                self._publish_nobody(self._tracker, waiting)
            answered = True
            self._tell_robot(waiting, self._tracker, posterior)
        except (ValueError, ArithmeticError) as error:
            text = error_line(error)
            if not answered:
                self._tell_robot(waiting)
            if not starts:
                self._log.skip(Fault.ESTIMATE, f'image of {stamp} ns can not be tracked: {text}')
                return
            # The next image would fail as this one did, after as long a time.
            self._log.skip(Fault.START, f'no track starts at the image of {stamp} ns: {text}')
            self.restart(replace(self.start, background=None, initial=None, box=None))

    def _publish_track(
        self,
        tracker: Tracker,
        waiting: WaitingImage,
        posterior: GaussianMixture,
        likelihood: GaussianMixture,
    ) -> None:
        p = self.parameters
        shown = self._shown_body
        starts = shown is None or not _looks_like(tracker.body, shown)
        if starts:
            self._shown_body = tracker.body
        frame = waiting.frame_id
        fixed = None
        if p.publish_in_fixed_frame:
            if self.frames.pose is None:
                self._log.skip(
                    Fault.NO_CAMERA_POSE,
                    f'the image of {waiting.stamp_ns} ns is tracked, but not published: its place '
                    f'in fixed_frame {p.fixed_frame!r} is unknown',
                )
                return
            fixed = FixedFrame(p.fixed_frame, self.frames.pose, self._turn)
            self._turn = fixed.turn_of(tracker.body, posterior.means[0])
        track = TrackedImage(
            image=waiting.image,
            stamp_ns=waiting.stamp_ns,
            frame_id=frame,
            body=tracker.body,
            camera=tracker.camera,
            posterior=posterior,
            likelihood=likelihood,
            log_likelihoods=tracker.modes.log_likelihoods,
            likelihood_values=tracker.log_likelihoods,
            likelihood_errors=tracker.likelihood_errors,
            shape_covariance=tracker.shape_covariance,
            point=tracker.point_estimate,
            ground=tracker.ground,
            contacts=tracker.contacts,
            starts=starts,
            state=TrackState.LOST if tracker.status is Status.LOST else TrackState.TRACKING,
            track_id=tracker.track_id,
            existence_probability=tracker.existence_probability,
            cue_probabilities=tracker.validity.shown,
            identities=tracker.modes.identities,
            velocities=tracker.velocities,
            up=tracker.vertical,
            fixed=fixed,
        )
        presentation = Presentation(
            tracker.settings.max_hypotheses,
            p.overlay_modes,
            p.publish_tf,
            p.frame_prefix,
            describe=starts or self._shown_frames != (frame, p.frame_prefix),
        )

        track_messages(
            self._messages,
            track,
            presentation,
            self._wanted,
            lambda topic, message: self._publish(topic, waiting.stamp_ns, message),
        )
        self._shown_frames = (frame, p.frame_prefix)
        self._weights = posterior.weights
        self._log.counts['tracked'] += 1

    def _tell_robot(
        self,
        waiting: WaitingImage,
        tracker: Tracker | None = None,
        posterior: GaussianMixture | None = None,
    ) -> None:
        """Publishes what a robot acts on; of every image, whatever it shows.

        Args:
            waiting: the image.
            tracker: after the image; None: it could not be tracked.
            posterior: of the image; None: there is no track.
        """
        p, seen, frame, fixed = self.parameters, None, waiting.frame_id, None
        placed = True
        if p.publish_in_fixed_frame:
            frame, placed = p.fixed_frame, self.frames.pose is not None
            if self.frames.pose is not None:
                fixed = FixedFrame(p.fixed_frame, self.frames.pose, self._turn)
        state = KeepOutState.UNKNOWN if tracker is None else _STATES[tracker.status]
        if state is KeepOutState.NOBODY and tracker is not None and not tracker.nobody_shown:
            # An earlier image has said so, and this one says nothing.
            state = KeepOutState.UNKNOWN
        if state is KeepOutState.TRACKING and tracker is not None:
            if placed and posterior is not None and not tracker.foreseen:
                seen = LastSeen(
                    waiting.stamp_ns, waiting.frame_id, tracker.body, posterior, tracker.forecaster,
                    fixed, p.keep_out_probability,
                )  # fmt: skip
            else:
                state = KeepOutState.LOST
        number = self._tracks if tracker is None else tracker.track_id
        existence = math.nan if tracker is None else tracker.existence_probability
        with self._telling:
            self.robot.tell(waiting.stamp_ns, frame, state, number, existence, seen)
            robot_messages(self._messages, self.robot, p, self._wanted, self._publish)
            self.answered += 1

    def stale(self, silence: float, answered: int) -> list[Output]:
        """See `TrackingSession`."""
        with self._telling:
            return self._stale(silence) if answered == self.answered else []

    def _stale(self, silence: float) -> list[Output]:
        found: list[Output] = []

        def publish(topic: str, stamp: int, message: Any) -> None:
            found.append(Output(topic, stamp, serialise(message)))

        robot_messages(self._messages, self.robot, self.parameters, self._wanted, publish, silence)
        return found

    def _publish_nobody(self, tracker: Tracker, waiting: WaitingImage) -> None:
        """The end of a track whose person is no longer in view."""
        p = self.parameters
        nobody_messages(
            self._messages,
            tracker.body,
            tracker.track_id,
            tracker.existence_probability,
            tracker.settings.max_hypotheses,
            waiting.stamp_ns,
            f'{p.fixed_frame}_optical' if p.publish_in_fixed_frame else waiting.frame_id,
            waiting.image if p.overlay_modes else None,
            self._wanted,
            lambda topic, message: self._publish(topic, waiting.stamp_ns, message),
        )
        self._weights = np.empty(0)

    # State.

    def _present_state(self) -> FilterState:
        tracker = self._tracker if len(self._weights) else None
        silhouettes = None if self._tracker is None else self._tracker.silhouettes
        source = None if self._tracker is None else self._tracker.started_from
        return FilterState(
            *self._status_and_wants(),
            **self._totals(),
            body=self._shown_body,
            modes=len(self._weights),
            misfit=math.nan if tracker is None else tracker.misfit,
            evaluations=0 if tracker is None else tracker.evaluations,
            background='unknown' if silhouettes is None else silhouettes.known,
            doubted=silhouettes is not None and silhouettes.doubted,
            moved=silhouettes is not None and silhouettes.watch.moved,
            track_id=self._tracks if self._tracker is None else self._tracker.track_id,
            existence=math.nan if self._tracker is None else self._tracker.existence_probability,
            started_from='' if source is None else source.value,
            beliefs={} if tracker is None else tracker.validity.shown,
        )

    def _status(self) -> tuple[str, str]:
        status = Status.WAITING if self._tracker is None else self._tracker.status
        wants = self.start.wants(self.parameters.sources) if status is Status.WAITING else ''
        return status.value, wants


def _looks_like(body: Body, shown: Body) -> bool:
    """Whether a body is the one that has been described, up to small changes of its estimate."""
    if body.dof_names != shown.dof_names:
        return False
    change = np.abs(body.skeleton.lengths - shown.skeleton.lengths)
    return bool(change.max(initial=0.0) <= RESHAPED)
