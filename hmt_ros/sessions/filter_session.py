"""The filter behind its topics: messages in, messages out, without ROS.

The node and offline replay give their messages to a `FilterSession`, one after the other; the same
messages in the same order give the same bytes. The rules:

- Images are tracked in the order of their stamps. One that is not younger than the one before is
  skipped, or starts the track anew where `reset_on_time_jump` says so.
- An image waits until a calibrated camera_info has come, and with `use_keypoints` until keypoints
  of exactly its stamp have come, or keypoints of a later stamp, or an image that is
  `keypoints_timeout` younger; with `use_predictions` and `prediction_timeout` for a pose_prediction
  in the same way. Of several of one stamp the last counts; keypoints without names, and mixtures
  without components, say that nobody was seen. At most `queue_size` images wait; the oldest are
  dropped.
- A camera_info with another calibration, and ~/reset, start the track anew.
- What can not be used is skipped. Of each kind of fault the first is told, all are counted.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.image.observation import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.sessions.camera_input import CAMERA_INFO, IMAGE, CameraInput, InTime, WaitingImage
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.handled import Handled, Output
from hmt_ros.sessions.session import Session, entropy, everything
from hmt_ros.sessions.stamped_inputs import StampedInputs
from hmt_ros.sessions.track_messages import Presentation, TrackedImage, track_messages
from hmt_ros.sessions.track_start import TrackStart, prepare_start
from hmt_ros.tracking import PosePrediction, Status, Subject, Tracker
from msg_tools import MessageError
from msg_tools.files.error_line import error_line
from msg_tools.messages.bodies import body_of
from msg_tools.messages.headers import SECOND_NS, time_ns
from msg_tools.messages.keypoints import keypoints_of
from msg_tools.messages.pose_mixtures import pose_mixture_of

KEYPOINTS, PREDICTION = 'keypoints', 'pose_prediction'

# A person hardly moves meanwhile.
_SAME_MOMENT_NS = SECOND_NS // 5


@dataclass(frozen=True)
class SessionState:
    """What is going on, for diagnostics.

    Attributes:
        status: 'no camera', 'waiting', 'tracking' or 'lost'.
        wants: what the next step waits for, '' while tracking.
        body: of the present track; None: there is none.
        modes: components of the posterior.
        entropy: of their weights, nats.
        misfit: share of the image that no mode explains.
        evaluations: of the likelihood in the last image.
        images: number of images: 'received', and of these 'tracked', 'skipped', 'dropped'.
        faults: number of faults by kind.
        last_fault: the newest; '' before the first.
    """

    status: str
    wants: str
    body: Body | None = None
    modes: int = 0
    entropy: float = 0.0
    misfit: float = 0.0
    evaluations: int = 0
    images: Counter[str] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    last_fault: str = ''


class FilterSession(Session):
    """One person before one camera, from the first message on.

    All methods are to be called by one thread; `state` and `parameters` may be read and replaced by
    others.

    Args:
        parameters: of the node.
        publish: takes what is to be published, as soon as it is there.
        wanted: whether a topic needs to be published.

    Raises:
        ValueError: the parameters name a file that can not be used.

    Attributes:
        parameters: a new value takes effect when `declared_parameters` says.
        start: what the present track started from.
        state: see `SessionState`.
    """

    def __init__(
        self,
        parameters: FilterParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        super().__init__(parameters, publish, wanted)
        self.start = prepare_start(parameters)
        self._input = CameraInput(self._log, 'the track')
        self._tracker: Tracker | None = None
        self._shown_body: Body | None = None
        self._shown_frames: tuple[str, str] | None = None
        self._keypoints: StampedInputs[Keypoints] = StampedInputs()
        self._predictions: StampedInputs[PosePrediction] = StampedInputs()
        self._weights = np.empty(0)
        self.state = self._present_state()

    # What comes in.

    def take(self, source: str, message: Any) -> Handled:
        """Handles a message.

        Args:
            source: `CAMERA_INFO`, `IMAGE`, `KEYPOINTS` or `PREDICTION`.
            message: sensor_msgs/CameraInfo, Image or CompressedImage, hmt_msgs/Keypoints2D or
                PoseMixture.
        """
        self._log.begin()
        stamp = time_ns(message.header.stamp)
        if source == IMAGE:
            self._take_image(message, stamp)
        elif source == CAMERA_INFO:
            if self._input.take_camera_info(message):
                self._start_anew()
        elif source == KEYPOINTS:
            self._keypoints.put(stamp, self._keypoints_in(message))
        else:
            self._predictions.put(stamp, self._prediction_in(message))
        self._track_what_is_ready()
        self.state = self._present_state()
        return self._log.handled(source, stamp)

    def restart(self, start: TrackStart | None = None) -> None:
        """Drops the track; the next image starts a new one.

        Args:
            start: from what; None: as the parameters say.

        Raises:
            ValueError: the parameters name a file that can not be used; the track goes on.
        """
        self.start = prepare_start(self.parameters) if start is None else start
        self._tracker = None
        self._shown_body = None
        self._weights = np.empty(0)
        self.state = self._present_state()

    def _take_image(self, message: Any, stamp: int) -> None:
        in_time = self._input.judge_stamp(stamp, self.parameters.reset_on_time_jump)
        if in_time is InTime.SKIPPED:
            return
        if in_time is InTime.JUMP:
            self._track_all()
            self._keypoints.clear()
            self._predictions.clear()
            self._start_anew()
        self._input.take_image(message, stamp)

    def _start_anew(self) -> None:
        try:
            self.restart()
        except ValueError as error:
            self._log.fault('start', f'{error}; the track starts as the time before')
            self.restart(self.start)

    def _keypoints_in(self, message: Any) -> Keypoints | None:
        """Keypoints that were seen; None: none at all."""
        if len(message.names) == 0:
            return None
        try:
            content = keypoints_of(message, self.parameters.keypoint_sigma_px)
        except MessageError as error:
            self._log.fault('keypoints', str(error))
            return None
        joints = self.start.body.joint_names
        known = np.array([name in joints for name in content.names])
        if not known.all():
            strange = [name for name, ok in zip(content.names, known, strict=True) if not ok]
            self._log.note('names of keypoints', f'keypoints {strange} are no joints of the body')
        use = np.flatnonzero(known & content.seen)
        if len(use) == 0:
            return None
        return Keypoints(
            tuple(content.names[i] for i in use),
            content.pixels[use],
            content.covariances[use],
            content.confidence[use],
        )

    def _prediction_in(self, message: Any) -> PosePrediction | None:
        """A mixture over poses and its body, see `body_of`; None: nobody was seen."""
        if len(message.components) == 0:
            return None
        try:
            content = pose_mixture_of(message)
            return PosePrediction(content.mixture, body_of(content, self.start.body))
        except ValueError as error:
            self._log.fault('pose_prediction', f'pose_prediction: {error}')
            return None

    # What comes out.

    def _track_what_is_ready(self) -> None:
        source = self._input
        while source.waiting and source.camera is not None and self._is_ready(source.waiting[0]):
            self._track(source.waiting.popleft(), source.camera)
        size = self.parameters.queue_size
        for dropped in source.drop_excess(size):
            what = 'pose_prediction' if self._has_keypoints(dropped.stamp_ns) else 'keypoints'
            self._log.fault(
                f'no {what}',
                f'image of {dropped.stamp_ns} ns is dropped: no {what} of its stamp has come, and '
                f'queue_size is {size}',
            )

    def _track_all(self) -> None:
        """Nothing more comes of this track: what waits is tracked as it is."""
        source = self._input
        while source.waiting and source.camera is not None:
            self._track(source.waiting.popleft(), source.camera)
        source.forget_images()

    def _is_ready(self, waiting: WaitingImage) -> bool:
        stamp = waiting.stamp_ns
        return self._has_keypoints(stamp) and self._has_prediction(stamp)

    def _has_keypoints(self, stamp: int) -> bool:
        p = self.parameters
        return not p.use_keypoints or self._has(self._keypoints, stamp, p.keypoints_timeout)

    def _has_prediction(self, stamp: int) -> bool:
        p = self.parameters
        return not p.use_predictions or self._has(self._predictions, stamp, p.prediction_timeout)

    def _has(self, inputs: StampedInputs[Any], stamp: int, timeout: float) -> bool:
        assert self._input.newest is not None
        return inputs.is_settled(stamp) or self._input.newest - stamp > timeout * SECOND_NS

    def _track(self, waiting: WaitingImage, camera: Camera) -> None:
        if not self._input.fits(waiting):
            return
        stamp = waiting.stamp_ns
        keypoints = self._keypoints.take(stamp) if self.parameters.use_keypoints else None
        prediction = self._predictions.take(stamp) if self.parameters.use_predictions else None
        starts = self._tracker is None or self._tracker.status is Status.WAITING
        try:
            if self._tracker is None:
                self._tracker = self.start.tracker(camera)
            posterior, likelihood = self._tracker.step(waiting.image, stamp, keypoints, prediction)
            if starts and posterior is not None:
                self._tell_how_old_the_start_is(stamp)
            if posterior is not None and likelihood is not None:
                self._publish_track(self._tracker, waiting, posterior, likelihood)
        except (ValueError, ArithmeticError) as error:
            text = error_line(error)
            if not starts:
                self._log.skip('estimate', f'image of {stamp} ns can not be tracked: {text}')
                return
            # The next image would fail as this one did, after as long a time.
            self._log.skip('start', f'no track starts at the image of {stamp} ns: {text}')
            self.restart(replace(self.start, background=None, initial=None))

    def _tell_how_old_the_start_is(self, stamp_ns: int) -> None:
        initial = self.start.initial
        if isinstance(initial, Subject) and stamp_ns - initial.stamp_ns > _SAME_MOMENT_NS:
            age = (stamp_ns - initial.stamp_ns) / SECOND_NS
            self._log.note(
                'old start',
                f'the joints that start the track were seen {age:.1f} s before its first image',
            )

    def _publish_track(
        self,
        tracker: Tracker,
        waiting: WaitingImage,
        posterior: GaussianMixture,
        likelihood: GaussianMixture,
    ) -> None:
        p = self.parameters
        shown = self._shown_body
        starts = shown is None or tracker.body.skeleton is not shown.skeleton
        frame = self._input.frame_of(waiting)
        track = TrackedImage(
            image=waiting.image,
            stamp_ns=waiting.stamp_ns,
            frame_id=frame,
            body=tracker.body,
            camera=tracker.camera,
            posterior=posterior,
            likelihood=likelihood,
            log_likelihoods=tracker.modes.log_likelihoods,
            starts=starts,
        )
        presentation = Presentation(
            tracker.settings.max_hypotheses,
            p.overlay_modes,
            p.overlay_quality,
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
        self._shown_body, self._shown_frames = tracker.body, (frame, p.frame_prefix)
        self._weights = posterior.weights
        self._log.counts['tracked'] += 1

    # What is told.

    def _present_state(self) -> SessionState:
        tracker = self._tracker
        status, wants = 'no camera', 'a calibrated camera_info'
        if self._input.camera is not None:
            status = (Status.WAITING if tracker is None else tracker.status).value
            wants = self._wants() if status == Status.WAITING.value else ''
        tracked = len(self._weights) > 0 and tracker is not None
        return SessionState(
            status,
            wants,
            body=self._shown_body,
            modes=len(self._weights),
            entropy=entropy(self._weights),
            misfit=tracker.misfit if tracker is not None and tracked else math.nan,
            evaluations=tracker.evaluations if tracker is not None and tracked else 0,
            images=Counter(self._log.counts),
            faults=Counter(self._log.faults),
            last_fault=self._log.last_fault,
        )

    def _wants(self) -> str:
        initial = self.start.initial
        if initial is None and self.parameters.use_predictions:
            return 'a pose_prediction with components'
        if initial is None:
            return 'subject_file, use_predictions, or ~/reset with a mixture'
        if isinstance(initial, GaussianMixture):
            return 'an image'
        return f'an image of {initial.stamp_ns} ns or later, where the subject was seen'
