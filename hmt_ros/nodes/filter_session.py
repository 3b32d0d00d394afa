"""The filter behind its topics: messages in, messages out, without ROS.

The node and offline replay give their messages to a `FilterSession`, one after the other; the same
messages in the same order give the same bytes. The rules:

- Images are tracked in the order of their stamps. One that is not younger than the one before is
  skipped, or starts the track anew where `reset_on_time_jump` says so.
- An image waits until a calibrated camera_info has come, and with `use_keypoints` until keypoints
  of exactly its stamp have come, or keypoints of a later stamp, or an image that is
  `keypoints_timeout` younger. Of several keypoints of one stamp the last counts; keypoints without
  names say that a detector saw nobody. At most `queue_size` images wait; the oldest are dropped.
- A camera_info with another calibration, and ~/reset, start the track anew.
- What can not be used is skipped. Of each kind of fault the first is told, all are counted.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body import Body, Camera
from hmt_ros.image.observation import Keypoints
from hmt_ros.inference import GaussianMixture
from hmt_ros.nodes.filter_parameters import FilterParameters
from hmt_ros.nodes.handled import Handled, HandlingLog, Output
from hmt_ros.nodes.track_messages import Presentation, TrackedImage, track_messages
from hmt_ros.nodes.track_start import TrackStart, prepare_start
from hmt_ros.tracking import Status, Subject, Tracker
from msg_tools import MessageError, RosbagsMessages
from msg_tools.camera_info import CameraInfoError, camera_from_info
from msg_tools.cdr import serialise
from msg_tools.headers import SECOND_NS, time_ns
from msg_tools.images import ImageError, decode_image
from msg_tools.keypoints import keypoints_of

CAMERA_INFO, IMAGE, KEYPOINTS = 'camera_info', 'image', 'keypoints'
FRAME_ID = 'camera_optical_frame'  # where neither image nor camera_info names a frame

# A person hardly moves meanwhile.
_SAME_MOMENT_NS = SECOND_NS // 5
# Stamps of keypoints that are remembered.
_REMEMBERED = 256


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


class _WaitingImage(NamedTuple):
    image: NDArray[np.uint8]
    stamp_ns: int
    frame_id: str


def _everything(_topic: str) -> bool:
    return True


class FilterSession:
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
        wanted: Callable[[str], bool] = _everything,
    ) -> None:
        self.parameters = parameters
        self._publish_output = publish
        self._wanted = wanted
        self._messages = RosbagsMessages()
        self.start = prepare_start(parameters)
        self._camera: Camera | None = None
        self._camera_frame = ''
        self._tracker: Tracker | None = None
        self._shown_body: Body | None = None
        self._waiting: deque[_WaitingImage] = deque()
        self._keypoints: dict[int, Keypoints | None] = {}
        self._newest_keypoints = -1
        self._newest_image: int | None = None
        self._weights = np.empty(0)
        self._images: Counter[str] = Counter()
        self._log = HandlingLog()
        self.state = self._present_state()

    # What comes in.

    def take(self, source: str, message: Any) -> Handled:
        """Handles a message.

        Args:
            source: `CAMERA_INFO`, `IMAGE` or `KEYPOINTS`.
            message: sensor_msgs/CameraInfo, Image or CompressedImage, hmt_msgs/Keypoints2D.
        """
        self._log.begin()
        stamp = time_ns(message.header.stamp)
        if source == IMAGE:
            self._take_image(message, stamp)
        elif source == CAMERA_INFO:
            self._take_camera_info(message)
        else:
            self._take_keypoints(message, stamp)
        self._track_what_is_ready()
        self.state = self._present_state()
        return self._log.handled(source, stamp)

    def refuse(self, source: str, text: str) -> Handled:
        """Counts a message that could not even be read."""
        self._log.begin()
        self._log.fault('message', f'message of {source} can not be read: {text}')
        self.state = self._present_state()
        return self._log.handled(source, 0)

    def count_dropped(self, images: int) -> None:
        """Counts images that were dropped before they came here, because the node was late."""
        self._images['received'] += images
        self._images['dropped'] += images

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

    def _take_camera_info(self, message: Any) -> None:
        try:
            camera = camera_from_info(message)
        except CameraInfoError as error:
            self._log.fault('camera_info', str(error))
            return
        self._camera_frame = str(message.header.frame_id)
        if camera == self._camera:
            return
        known, self._camera = self._camera, camera
        if known is not None:
            self._log.note('calibration', 'camera_info changes: the track starts anew')
            self._start_anew()

    def _take_keypoints(self, message: Any, stamp: int) -> None:
        self._newest_keypoints = max(self._newest_keypoints, stamp)
        self._keypoints[stamp] = self._keypoints_in(message)
        while len(self._keypoints) > _REMEMBERED:
            del self._keypoints[min(self._keypoints)]

    def _take_image(self, message: Any, stamp: int) -> None:
        self._images['received'] += 1
        newest = self._newest_image
        if newest is not None and stamp <= newest:
            text = f'image of {stamp} ns comes after one of {newest} ns'
            if stamp == newest:
                self._skip('time stands still', f'{text}, wanted stamps that increase')
                return
            if not self.parameters.reset_on_time_jump:
                self._skip(
                    'time jumps back',
                    f'{text}: skipped; with reset_on_time_jump the track would start anew',
                )
                return
            self._log.note('time jumps back', f'{text}: the track starts anew')
            self._track_all()
            self._keypoints.clear()
            self._newest_keypoints = -1
            self._newest_image = None
            self._start_anew()
        try:
            picture = decode_image(message)
        except ImageError as error:
            self._skip('image', str(error))
            return
        self._newest_image = stamp
        self._waiting.append(_WaitingImage(picture, stamp, str(message.header.frame_id)))

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

    # What comes out.

    def _track_what_is_ready(self) -> None:
        while self._waiting and self._camera is not None and self._has_keypoints(self._waiting[0]):
            self._track(self._waiting.popleft(), self._camera)
        while len(self._waiting) > self.parameters.queue_size:
            dropped = self._waiting.popleft()
            self._images['dropped'] += 1
            if self._camera is None:
                # An uncalibrated camera_info has been told already.
                self._log.fault(
                    'camera_info',
                    f'image of {dropped.stamp_ns} ns is dropped: it waited for a calibrated '
                    'camera_info',
                )
            else:
                self._log.fault(
                    'no keypoints',
                    f'image of {dropped.stamp_ns} ns is dropped: no keypoints of its stamp have '
                    f'come, and queue_size is {self.parameters.queue_size}',
                )

    def _track_all(self) -> None:
        """Nothing more comes of this track: what waits is tracked as it is."""
        while self._waiting and self._camera is not None:
            self._track(self._waiting.popleft(), self._camera)
        self._images['dropped'] += len(self._waiting)
        self._waiting.clear()

    def _has_keypoints(self, waiting: _WaitingImage) -> bool:
        if not self.parameters.use_keypoints:
            return True
        stamp = waiting.stamp_ns
        if stamp in self._keypoints or self._newest_keypoints > stamp:
            return True
        assert self._newest_image is not None
        return self._newest_image - stamp > self.parameters.keypoints_timeout * SECOND_NS

    def _track(self, waiting: _WaitingImage, camera: Camera) -> None:
        height, width = waiting.image.shape[:2]
        if (width, height) != (camera.width, camera.height):
            self._skip(
                'size of the image',
                f'image has {width}x{height} pixels, wanted the {camera.width}x{camera.height} of '
                'camera_info',
            )
            return
        keypoints = None
        if self.parameters.use_keypoints:
            keypoints = self._keypoints.get(waiting.stamp_ns)
            for stamp in [stamp for stamp in self._keypoints if stamp <= waiting.stamp_ns]:
                del self._keypoints[stamp]
        starts = self._tracker is None or self._tracker.status is Status.WAITING
        try:
            if self._tracker is None:
                self._tracker = self.start.tracker(camera)
            posterior, likelihood = self._tracker.step(waiting.image, waiting.stamp_ns, keypoints)
            if starts and posterior is not None:
                self._tell_how_old_the_start_is(waiting.stamp_ns)
            if posterior is not None and likelihood is not None:
                self._publish(self._tracker, waiting, posterior, likelihood)
        except (ValueError, ArithmeticError) as error:
            text = ' '.join(str(error).split()) or type(error).__name__
            if not starts:
                self._skip('estimate', f'image of {waiting.stamp_ns} ns can not be tracked: {text}')
                return
            # The next image would fail as this one did, after as long a time.
            self._skip('start', f'no track starts at the image of {waiting.stamp_ns} ns: {text}')
            self.restart(replace(self.start, background=None, initial=None))

    def _tell_how_old_the_start_is(self, stamp_ns: int) -> None:
        initial = self.start.initial
        if isinstance(initial, Subject) and stamp_ns - initial.stamp_ns > _SAME_MOMENT_NS:
            age = (stamp_ns - initial.stamp_ns) / SECOND_NS
            self._log.note(
                'old start',
                f'the joints that start the track were seen {age:.1f} s before its first image',
            )

    def _publish(
        self,
        tracker: Tracker,
        waiting: _WaitingImage,
        posterior: GaussianMixture,
        likelihood: GaussianMixture,
    ) -> None:
        p = self.parameters
        track = TrackedImage(
            image=waiting.image,
            stamp_ns=waiting.stamp_ns,
            frame_id=waiting.frame_id or self._camera_frame or FRAME_ID,
            body=tracker.body,
            camera=tracker.camera,
            posterior=posterior,
            likelihood=likelihood,
            log_likelihoods=tracker.modes.log_likelihoods,
            starts=self._shown_body is None
            or tracker.body.skeleton is not self._shown_body.skeleton,
        )
        presentation = Presentation(
            tracker.settings.max_hypotheses,
            p.overlay_modes,
            p.overlay_quality,
            p.publish_tf,
            p.frame_prefix,
        )

        def publish(topic: str, message: Any) -> None:
            self._log.published(topic, waiting.stamp_ns)
            self._publish_output(Output(topic, waiting.stamp_ns, serialise(message)))

        track_messages(self._messages, track, presentation, self._wanted, publish)
        self._shown_body = tracker.body
        self._weights = posterior.weights
        self._images['tracked'] += 1

    # What is told.

    def _skip(self, kind: str, text: str) -> None:
        self._images['skipped'] += 1
        self._log.fault(kind, text)

    def _present_state(self) -> SessionState:
        tracker = self._tracker
        status, wants = 'no camera', 'a calibrated camera_info'
        if self._camera is not None:
            status = (Status.WAITING if tracker is None else tracker.status).value
            wants = self._wants() if status == Status.WAITING.value else ''
        tracked = len(self._weights) > 0 and tracker is not None
        positive = self._weights[self._weights > 0]
        return SessionState(
            status,
            wants,
            body=self._shown_body,
            modes=len(self._weights),
            entropy=abs(float(-(positive * np.log(positive)).sum())) if tracked else math.nan,
            misfit=tracker.misfit if tracker is not None and tracked else math.nan,
            evaluations=tracker.evaluations if tracker is not None and tracked else 0,
            images=Counter(self._images),
            faults=Counter(self._log.faults),
            last_fault=self._log.last_fault,
        )

    def _wants(self) -> str:
        initial = self.start.initial
        if initial is None:
            return 'subject_file, or ~/reset with a mixture'
        if isinstance(initial, GaussianMixture):
            return 'an image'
        return f'an image of {initial.stamp_ns} ns or later, where the subject was seen'
