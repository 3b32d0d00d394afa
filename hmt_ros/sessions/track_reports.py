"""Log messages about changes of a track."""

from __future__ import annotations

from typing import NamedTuple

from hmt_ros.inference import GaussianMixture
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.camera_session import PERSON_IN_BACKGROUND_FAULT, camera_moved_fault
from hmt_ros.sessions.handled import HandlingLog
from hmt_ros.tracking import Status, Subject, Tracker
from hmt_ros.tracking.beginning import Source
from msg_tools.messages.headers import SECOND_NS

# Maximum age of a subject's joints without a warning, ns: a person hardly moves in that time.
_SAME_MOMENT_NS = SECOND_NS // 5


class TrackCondition(NamedTuple):
    """State of a track, compared between images to report changes.

    Attributes:
        status: status of the tracker.
        doubted: whether the background was learned with the person in it, and the track needs
            silhouettes (a track that started from keypoints does not).
        moved: whether the camera has moved since the background was taken.
        contradicted: whether the scene or the person contradicts the given gravity.
        track_id: number of the track.
        reversed: whether the opposite of the given gravity is used.
    """

    status: Status = Status.WAITING
    doubted: bool = False
    moved: bool = False
    contradicted: bool = False
    track_id: int = 0
    reversed: bool = False

    @classmethod
    def of(cls, tracker: Tracker | None) -> TrackCondition:
        """Return the condition of a tracker; None represents a tracker that waits for a start."""
        if tracker is None:
            return cls()
        silhouettes = tracker.silhouettes
        return cls(
            tracker.estimate.status,
            silhouettes.doubted
            and tracker.settings.likelihood.coverage.weight > 0.0
            and tracker.estimate.started_from is not Source.KEYPOINTS,
            silhouettes.watch.moved,
            tracker.estimate.gravity_contradicted,
            tracker.track_id,
            tracker.estimate.gravity_reversed,
        )


def report_change(
    log: HandlingLog,
    before: TrackCondition,
    tracker: Tracker,
    initial: Subject | GaussianMixture | None,
    stamp_ns: int,
) -> None:
    """Reports the changes of the track at an image.

    Args:
        initial: subject or mixture that the track starts from.
    """
    now = TrackCondition.of(tracker)
    if now.doubted and not before.doubted:
        log.note(
            'background',
            f'{PERSON_IN_BACKGROUND_FAULT}, as the image of {stamp_ns} ns shows: silhouettes are '
            'not used until the scene behind the person has been seen; give background_file, or '
            'start with the empty scene',
        )
    if now.moved and not before.moved:
        remedy = 'call ~/reset; a moving camera needs fixed_frame or use_mask'
        text = camera_moved_fault(tracker.silhouettes.watch.shift, stamp_ns, remedy)
        log.note('camera moved', text, warn=True)
    if now.contradicted and not before.contradicted:
        log.note(
            'direction of gravity',
            'the lines of the scene, or the person, contradict the given gravity, '
            f'{_numbers(-tracker.estimate.ground.up)}, at the image of {stamp_ns} ns; it is used '
            'anyway: check that it is in the optical frame (x right, y down, z forward), or '
            'gravity_frame and how the camera is mounted',
            warn=True,
        )
    newer = now.track_id != before.track_id and now.status is Status.TRACKING
    if now.reversed and not before.reversed:
        log.note(
            'direction of gravity',
            f'{reversed_gravity(tracker.estimate.ground.up)} ({stamp_ns} ns)',
            warn=True,
        )
    if newer or now.status is not before.status:
        _report_status(log, before, tracker, initial, stamp_ns)


def reversed_gravity(up: Array) -> str:
    """Return a warning that an accelerometer reading was given as gravity.

    Args:
        up: (3,) unit vector against gravity, camera frame.
    """
    return (
        'the given gravity points to the head of the person, as an accelerometer at rest '
        f'measures it: the opposite is used, {_numbers(-up)}'
    )


def _numbers(vector: Array) -> str:
    return '[' + ', '.join(f'{x:.2f}' for x in vector + 0.0) + ']'


def _report_status(
    log: HandlingLog,
    before: TrackCondition,
    tracker: Tracker,
    initial: Subject | GaussianMixture | None,
    stamp_ns: int,
) -> None:
    now, track = tracker.estimate.status, f'track {tracker.track_id}'
    at = f'at the image of {stamp_ns} ns'
    if now is Status.NOBODY:
        log.add_event(f'nobody in view {at}: {track} ends, another starts when somebody comes')
    elif now is Status.WAITING:
        log.add_event(f'{track} ends {at}: the person in view may be somebody else')
    elif tracker.track_id == before.track_id and before.status is Status.LOST:
        log.add_event(f'{track} is found again {at}')
    elif tracker.track_id != before.track_id:
        origin = (
            'what was given'
            if tracker.estimate.started_from is None
            else tracker.estimate.started_from.value
        )
        log.add_event(f'{track} starts from {origin} {at}')
        if isinstance(initial, Subject) and before.status is Status.WAITING:
            age = stamp_ns - initial.stamp_ns
            if age > _SAME_MOMENT_NS:
                log.note(
                    'old start',
                    f'the joints that start the track were seen {age / SECOND_NS:.1f} s before its '
                    'first image',
                )
    if now is Status.LOST:
        log.note(
            'loss of the track',
            f'{track} is lost {at}: {tracker.estimate.reason}; it is searched for',
            warn=True,
        )
