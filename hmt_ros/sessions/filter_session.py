"""The filter behind its topics.

The rules, besides those of `TrackingSession`:

- An image waits for the inputs that are used (`image_inputs`); keypoints without names, and
  mixtures without components, say that nobody was seen.
- When the person is no longer in view one mixture without components of either kind goes out, with
  markers that remove those before, and then nothing until a new track starts.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Mask
from hmt_ros.sessions.camera_session import (
    CAMERA_MOVED,
    IN_BACKGROUND,
    WaitingImage,
)
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.fixed_frame import FixedFrame
from hmt_ros.sessions.focal_length import with_depth_error
from hmt_ros.sessions.handled import Fault, Output
from hmt_ros.sessions.image_inputs import (
    INPUTS,
    KEYPOINTS,
    KEYPOINTS_3D,
    KEYPOINTS_INPUT,
    PREDICTION,
    PREDICTION_INPUT,
    ImageInput,
)
from hmt_ros.sessions.keypoint_inputs import KeypointReader, keypoints_input
from hmt_ros.sessions.robot_outputs import LastSeen, RobotOutputs
from hmt_ros.sessions.session import SessionState
from hmt_ros.sessions.track_messages import (
    TOPICS_OF_NODE,
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

# Change of a length above which a body is described anew, m.
RESHAPED = 0.005
_STATES = {
    Status.WAITING: KeepOutState.UNKNOWN,
    Status.TRACKING: KeepOutState.TRACKING,
    Status.LOST: KeepOutState.LOST,
    Status.NOBODY: KeepOutState.NOBODY,
}


@dataclass(frozen=True)
class FilterState(SessionState):
    """State of the filter: its status is 'no camera', or a value of `Status`.

    Attributes:
        body: of the present track; None: there is none.
        modes: components of the posterior.
        misfit: share of the image that no mode explains.
        evaluations: of the likelihood in the last image.
        background: its state, in a few words.
        doubted: whether it was learned with the person in it, and is not known again.
        moved: whether the camera has moved since it was taken.
        track_id: number of the present track, or of the last one; 0 before the first.
        started_from: input that this track began from; '' before the first.
        existence: probability that a person is in view; NaN: no image yet.
        beliefs: probability that each cue shows the person, and that the track has the person.
    """

    body: Body | None = None
    modes: int = 0
    misfit: float = 0.0
    evaluations: int = 0
    background: str = 'unknown'
    doubted: bool = False
    moved: bool = False
    track_id: int = 0
    started_from: str = ''
    existence: float = math.nan
    beliefs: Mapping[str, float] = field(default_factory=dict)

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{self.modes} modes'

    def trouble(self) -> str:
        """Whether the track is lost, nobody is in view, or the background is of no use."""
        if self.status == Status.NOBODY.value:
            return 'nobody in view'
        if self.status == Status.LOST.value:
            lost = f'lost: misfit {self.misfit:.2f}, existence {self.existence:.2f}'
            return f'{lost}; {CAMERA_MOVED}' if self.moved else lost
        if self.moved:
            return CAMERA_MOVED
        return f'{IN_BACKGROUND}; {self.background}' if self.doubted else ''

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [
            ('track', str(self.track_id)),
            ('started from', self.started_from),
            ('probability that a person is in view', f'{self.existence:.3f}'),
            ('modes', str(self.modes)),
            ('entropy of the weights, nats', f'{self.entropy:.3f}'),
            ('misfit', f'{self.misfit:.3f}'),
            *((f'belief in {cue}', f'{p:.2f}') for cue, p in self.beliefs.items()),
            ('background', self.background),
            ('evaluations of the likelihood', str(self.evaluations)),
        ]


class FilterSession(TrackingSession[FilterParameters, FilterState]):
    """Tracks one person before one camera; see `TrackingSession` for arguments and attributes.

    Attributes:
        robot: outputs for robots; may be read by any thread.
    """

    TOPICS = TOPICS_OF_NODE
    ESTIMATE = 'the track'
    CHECKED = ('subject_file', 'background_file', 'body_model', 'lifter')

    def _set_up(self) -> None:
        super()._set_up()
        self._tracker: Tracker | None = None
        self._tracks, self._turn = 0, 0.0
        self._shown_body: Body | None = None
        self._shown_frames: tuple[str, str] | None = None
        self._keypoints = KeypointReader(self.parameters.source, self._log)
        # From an image that was left out since the last estimate.
        self._late_prediction: PosePrediction | None = None
        self.robot = RobotOutputs()
        # A message of the watchdog never follows the answer to a newer image.
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
        """The mixture and its body, see `body_of`; `NOBODY`: nobody was seen; None: no prediction.

        Raises:
            ValueError: it can not be used; one line.
        """
        if len(message.components) == 0:
            # A predictor that leaves the image to the track has seen neither somebody nor nobody.
            left = message.state == TrackState.TRACKING or getattr(message, 'reason', '')
            return None if left else Status.NOBODY
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
        """The prediction from an image or, without that, from one left out before it."""
        found: PosePrediction | Status | None = waiting.content(PREDICTION)
        late, self._late_prediction = self._late_prediction, None
        return late if found is None else found

    # Outputs.

    def _estimate(self, waiting: WaitingImage, camera: Camera) -> None:
        p = self.parameters
        keypoints = self._keypoints.at_joints(
            waiting.content(KEYPOINTS),
            waiting.content(KEYPOINTS_3D),
            self.start.body,
            p.keypoint_scheme,
            waiting.stamp_ns,
        )
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
                self._tracker.set_gravity(seen.up, seen.camera_height, seen.up_sigma)
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
            if waiting.depth is not None and not self._tracker.estimate.validity.believes('depth'):
                self._log.note(
                    Fault.DEPTH_ELSEWHERE,
                    f'depth of {stamp} ns does not show the person where the image does: depth '
                    'images are not used until they do; wanted depth of the same time, registered '
                    'to the colour camera',
                )
            if posterior is not None and likelihood is not None:
                posterior = with_depth_error(posterior, self.parameters.focal_length_sigma)
                self._publish_track(self._tracker, waiting, posterior, likelihood)
            elif len(self._weights):
                self._publish_nobody(self._tracker, waiting)
            answered = True
            if not starts and self._tracker.estimate.status is Status.WAITING:
                # The track was of nobody.
                self.robot.forget()
            self._tell_robot(waiting, self._tracker, posterior)
        except (ValueError, ArithmeticError) as error:
            text = error_line(error)
            if not answered:
                self._tell_robot(waiting)
            if not starts:
                self._log.skip(Fault.ESTIMATE, f'image of {stamp} ns can not be tracked: {text}')
                return
            # The next image would fail in the same way, and take the same time.
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
        starts = shown is None or not _looks_like(tracker.estimate.body, shown)
        if starts:
            self._shown_body = tracker.estimate.body
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
            self._turn = fixed.turn_of(tracker.estimate.body, posterior.means[0])
        shown_frames = (waiting.frame_id, p.frame_prefix)
        track = TrackedImage(
            waiting,
            tracker,
            posterior,
            likelihood,
            p,
            starts=starts,
            describe=starts or self._shown_frames != shown_frames,
            fixed=fixed,
        )
        for topic, message in track_messages(track, self._wanted):
            self._publish(topic, waiting.stamp_ns, message)
        self._shown_frames = shown_frames
        self._weights = posterior.weights
        self._log.counts['tracked'] += 1

    def _tell_robot(
        self,
        waiting: WaitingImage,
        tracker: Tracker | None = None,
        posterior: GaussianMixture | None = None,
    ) -> None:
        """Publishes the outputs for robots, for every image, whatever it shows.

        Args:
            tracker: after the image; None: it could not be tracked.
            posterior: of the image; None: there is no track.
        """
        p, seen, frame, fixed = self.parameters, None, waiting.frame_id, None
        placed = True
        if p.publish_in_fixed_frame:
            frame, placed = p.fixed_frame, self.frames.pose is not None
            if self.frames.pose is not None:
                fixed = FixedFrame(p.fixed_frame, self.frames.pose, self._turn)
        state = KeepOutState.UNKNOWN if tracker is None else _STATES[tracker.estimate.status]
        if (
            state is KeepOutState.NOBODY
            and tracker is not None
            and not tracker.estimate.nobody_shown
        ):
            # An earlier image showed that nobody is there; this one shows nothing.
            state = KeepOutState.UNKNOWN
        if state is KeepOutState.TRACKING and tracker is not None:
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
        number, existence, reason = self._tracks, math.nan, 'the image can not be tracked'
        if tracker is not None:
            number, existence = tracker.track_id, tracker.estimate.existence_probability
            reason = tracker.estimate.reason
            if tracker.estimate.status is Status.WAITING and self.start.initial is not None:
                reason = f'waiting for {self.start.wants(())}'
        with self._telling:
            self.robot.tell(waiting.stamp_ns, frame, state, number, existence, seen, reason)
            for made in robot_messages(self.robot, p, self._wanted):
                self._publish(*made)
            self.answered += 1

    def stale(self, silence: float, answered: int) -> list[Output]:
        """See `TrackingSession`."""
        with self._telling:
            if answered != self.answered:
                return []
            made = robot_messages(self.robot, self.parameters, self._wanted, silence)
            return [Output(topic, stamp, serialise(message)) for topic, stamp, message in made]

    def _publish_nobody(self, tracker: Tracker, waiting: WaitingImage) -> None:
        """The end of a track whose person is no longer in view."""
        for topic, message in nobody_messages(tracker, waiting, self.parameters, self._wanted):
            self._publish(topic, waiting.stamp_ns, message)
        self._weights = np.empty(0)

    # State.

    def _present_state(self) -> FilterState:
        tracker = self._tracker if len(self._weights) else None
        silhouettes = None if self._tracker is None else self._tracker.silhouettes
        source = None if self._tracker is None else self._tracker.estimate.started_from
        return FilterState(
            *self._status_and_wants(),
            **self._totals(),
            body=self._shown_body,
            modes=len(self._weights),
            misfit=math.nan if tracker is None else tracker.estimate.misfit,
            evaluations=0 if tracker is None else tracker.estimate.evaluations,
            background='unknown' if silhouettes is None else silhouettes.known,
            doubted=TrackCondition.of(self._tracker).doubted,
            moved=silhouettes is not None and silhouettes.watch.moved,
            track_id=self._tracks if self._tracker is None else self._tracker.track_id,
            existence=math.nan
            if self._tracker is None
            else self._tracker.estimate.existence_probability,
            started_from='' if source is None else source.value,
            beliefs={} if tracker is None else tracker.estimate.validity.shown,
        )

    def _status(self) -> tuple[str, str]:
        status = Status.WAITING if self._tracker is None else self._tracker.estimate.status
        wants = self.start.wants(self.parameters.sources) if status is Status.WAITING else ''
        return status.value, wants


def _looks_like(body: Body, shown: Body) -> bool:
    """Whether a body is the one that has been described, up to small changes of its estimate."""
    if body.dof_names != shown.dof_names:
        return False
    change = np.abs(body.skeleton.lengths - shown.skeleton.lengths)
    return bool(change.max(initial=0.0) <= RESHAPED)
