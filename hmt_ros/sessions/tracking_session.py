"""Session of the filter, which tracks one person; `PeopleSession` tracks several people.

The rules, in addition to those of `CameraSession`:

- An image waits for the enabled inputs (`image_inputs`); keypoints without names, and
  mixtures without components, mean that nobody was seen.
- A camera_info with a different calibration, and ~/reset, restart the tracks.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from hmt_ros.body import Body, Camera
from hmt_ros.sessions.camera_frames import CameraFrames
from hmt_ros.sessions.camera_session import (
    CAMERA_MOVED_FAULT,
    PERSON_IN_BACKGROUND_FAULT,
    CameraSession,
    CameraState,
    WaitingImage,
)
from hmt_ros.sessions.handled import Output
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
from hmt_ros.sessions.named_file import public_line
from hmt_ros.sessions.seen_images import SeenImages
from hmt_ros.sessions.session import PublishedTopic, SessionState
from hmt_ros.sessions.track import Seen, Shared, Track
from hmt_ros.sessions.track_messages import TOPICS_OF_NODE
from hmt_ros.sessions.track_reports import TrackCondition
from hmt_ros.sessions.track_start import TrackStart, prepare_start
from hmt_ros.sessions.tracking_parameters import FilterParameters
from hmt_ros.tracking import PosePrediction, Status
from msg_tools.messages.bodies import body_of
from msg_tools.messages.pose_mixtures import TrackState, pose_mixture_message, pose_mixture_of


@dataclass(frozen=True)
class TrackingState(CameraState):
    """State of the filter: its status is 'no camera', or a value of `Status`.

    Attributes:
        body: body of the present track; None without a track.
        modes: number of components of the posterior.
        misfit: fraction of the image that no mode explains.
        evaluations: number of evaluations of the likelihood in the last image.
        background: state of the background, in a few words.
        doubted: whether the background was learned with the person in it, and is still unknown.
        track_id: number of the present or last track; 0 before the first track.
        started_from: input that the track started from; '' before the first track.
        existence: probability that a person is in view; NaN before the first image.
        beliefs: probability that each cue shows the person, and that the track follows the person.
    """

    body: Body | None = None
    modes: int = 0
    misfit: float = 0.0
    evaluations: int = 0
    background: str = 'unknown'
    doubted: bool = False
    track_id: int = 0
    started_from: str = ''
    existence: float = math.nan
    beliefs: Mapping[str, float] = field(default_factory=dict)

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{self.modes} modes'

    def trouble(self) -> str:
        """Return the problem: lost track, nobody in view, or unusable background; '' if none."""
        if self.status == Status.NOBODY.value:
            return 'nobody in view'
        if self.status == Status.LOST.value:
            lost = f'lost: misfit {self.misfit:.2f}, existence {self.existence:.2f}'
            return f'{lost}; {CAMERA_MOVED_FAULT}' if self.moved else lost
        learned = f'{PERSON_IN_BACKGROUND_FAULT}; {self.background}' if self.doubted else ''
        return super().trouble() or learned

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


class TrackingSession(CameraSession[FilterParameters, Any]):
    """Tracks people in the images of a camera; see `Session` for arguments and attributes.

    Attributes:
        start: data that new tracks start from.
        tracks: tracks of the people; always one in this class.
    """

    TOPICS: ClassVar[Mapping[str, PublishedTopic]] = TOPICS_OF_NODE
    DONE = 'tracked'
    ESTIMATE = 'the track'
    CHECKED: ClassVar[tuple[str, ...]] = (
        'subject_file',
        'background_file',
        'body_model',
        'lifter',
    )

    tracks: Sequence[Track]

    def _set_up(self) -> None:
        super()._set_up()
        p = self.parameters
        self.start = prepare_start(p)
        self.frames = CameraFrames(p.gravity_frame, p.fixed_frame, floor=p.floor_in_gravity_frame)
        self._shared = Shared(self.frames, self._log, self._publish, self._wanted)
        self._keypoints = KeypointReader(p.source, self._log)
        self._begin()
        self.state = self._present_state()

    def share(self, images: SeenImages) -> None:
        """See `Session`."""
        self._shared.seen_images = images

    @property
    def answered(self) -> int:
        """Number of images for which outputs for robots were published."""
        return self._shared.answered

    def restart(self, start: TrackStart | None = None) -> None:
        """Drops the tracks; new ones start with the images that follow.

        Args:
            start: data that the new tracks start from; None: data that the parameters name or, if
                a file can not be used, the previous data.
        """
        if start is None:
            try:
                start = prepare_start(self.parameters)
            except ValueError as error:
                text = f'{public_line(error)}; {self.ESTIMATE} starts as it did the last time'
                self._log.fault('start', text)
                start = self.start
        self.start = start
        for track in self.tracks:
            track.restart(start)
        super().restart()

    def stale(self, silence: float, answered: int) -> list[Output]:
        """Return messages that tell robots that the estimate is old. Thread-safe.

        Args:
            silence: time since the outputs for the newest image were published, s.
            answered: value of the attribute `answered` when `silence` was measured; if it has
                changed since then, no messages are returned.
        """
        with self._shared.answering:
            if answered != self.answered:
                return []
            return [made for track in self.tracks for made in track.stale(silence)]

    def forecast(self, stamp_ns: int) -> Any:
        """Return the hmt_msgs/PoseMixture of a forecast, see `RobotOutputs`. Thread-safe."""
        return pose_mixture_message(self._messages, self.tracks[0].robot.forecast(stamp_ns))

    def _estimate(self, waiting: WaitingImage, camera: Camera) -> None:
        for kind, text in self.frames.update(waiting.frame_id, waiting.stamp_ns):
            self._log.note(kind, text)
        outcomes = set()
        for track, seen in self._people_in(waiting, camera):
            self._log.prefix = f'{track.person}: ' if track.person else ''
            outcomes.add(track.follow(waiting, camera, seen, self.parameters))
            self._log.prefix = ''
        # Images are counted, not people.
        if True in outcomes:
            self._log.counts['tracked'] += 1
        elif False in outcomes:
            self._log.counts['skipped'] += 1

    def _jump_back(self, first: int, last: int) -> None:
        super()._jump_back(first, last)
        # After a jump back, track numbers start from 1 again.
        self._keypoints.chosen.forget()
        self._begin()

    # Methods for one person; `PeopleSession` overrides them.

    def _begin(self) -> None:
        """Resets the tracks to the state before the first image."""
        self.tracks = (Track('', self.parameters, self.start, self._shared),)

    @classmethod
    def inputs_of(cls, parameters: FilterParameters) -> tuple[ImageInput, ...]:
        """See `CameraSession`."""
        own = keypoints_input(parameters.source)
        return tuple(own if row is KEYPOINTS_INPUT else row for row in INPUTS)

    def _read_input(self, row: ImageInput, message: Any, stamp: int) -> Any:
        if row.name == KEYPOINTS:
            return self._keypoints.read(
                message, stamp, self.parameters, self.start.body, self._camera
            )
        if row is PREDICTION_INPUT:
            return self._prediction_in(message)
        return super()._read_input(row, message, stamp)

    def _prediction_in(self, message: Any) -> PosePrediction | Status | None:
        """Return the mixture with its body; `NOBODY` if nobody was seen; None without a prediction.

        Raises:
            ValueError: the message can not be used (one-line message).
        """
        if len(message.components) == 0:
            # A predictor that has not evaluated an image does not know whether it shows anybody.
            left = message.state == TrackState.TRACKING or getattr(message, 'reason', '')
            return None if left else Status.NOBODY
        try:
            content = pose_mixture_of(message)
            return PosePrediction(content.mixture, body_of(content, self.start.body))
        except ValueError as error:
            raise ValueError(f'pose_prediction: {error}') from error

    def _people_in(self, waiting: WaitingImage, camera: Camera) -> Iterator[tuple[Track, Seen]]:
        """Yields each track with its evidence; the caller updates the track before the next one."""
        keypoints = self._keypoints.at_joints(
            waiting.content(KEYPOINTS),
            waiting.content(KEYPOINTS_3D),
            self.start.body,
            self.parameters.keypoint_scheme,
            waiting.stamp_ns,
        )
        # A person moves little between images: a late prediction is still a useful hypothesis.
        taken = self._inputs[PREDICTION].take_all(waiting.stamp_ns).values()
        known = [one for one in taken if one is not None and self.parameters.use_predictions]
        prediction = known[-1] if known else None
        yield self.tracks[0], Seen(keypoints, prediction)

    def _present_state(self) -> SessionState:
        track = self.tracks[0]
        known, tracker = track.tracker, track.tracker if len(track.weights) else None
        source = None if known is None else known.estimate.started_from
        return TrackingState(
            *self._status_and_wants(),
            **self._totals(track.weights),
            body=track.body,
            modes=len(track.weights),
            misfit=math.nan if tracker is None else tracker.estimate.misfit,
            evaluations=0 if tracker is None else tracker.estimate.evaluations,
            background='unknown' if known is None else known.silhouettes.known,
            doubted=TrackCondition.of(known).doubted,
            moved=known is not None and known.silhouettes.watch.moved,
            track_id=track.track_id,
            existence=math.nan if known is None else known.estimate.existence_probability,
            started_from='' if source is None else source.value,
            beliefs={} if tracker is None else tracker.estimate.validity.shown,
        )

    def _status(self) -> tuple[str, str]:
        status = self.tracks[0].status
        start, sources = self.tracks[0].start, self.parameters.sources
        return status.value, start.wants(sources) if status is Status.WAITING else ''
