"""Several people in front of one camera: detections in, one track for each person.

The rules, in addition to those of `CameraSession`:

- An image waits for its detections (`image_inputs`).
- Identities given by the detector are kept. People without an identity are distinguished by their
  last position and motion (`hmt_ros.image.association`).
- Detections that match no followed person start tracks, the largest first, up to `max_people`. A
  person who is no longer in view (`Tracker.status`), or whose track does not begin, is dropped.
- The nearest person is tracked first. For each person, pixels that a nearer person covers, or that
  only a farther person covers, are unknown (`Tracker.step`, others).
- The background is learned while nobody is detected, or read from `background_file`.
- For every image with known detections, a list of the tracked people is published, together with
  markers and an overlay of all people.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.body.camera_pose import CameraPose
from hmt_ros.core import elementary
from hmt_ros.image.association import (
    GATE_COST,
    ImageTrack,
    Sighting,
    assigned,
    grown,
    hull,
    moved,
    unknown_area,
)
from hmt_ros.image.background import BackgroundModel, SceneWatch
from hmt_ros.image.person_shape import covered
from hmt_ros.image.silhouettes import Silhouettes, region_of
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Array, Mask
from hmt_ros.sessions.camera_session import CameraState, WaitingImage
from hmt_ros.sessions.image_inputs import (
    DEPTH_INPUT,
    DETECTIONS,
    DETECTIONS_INPUT,
    MASK_INPUT,
    SOURCES,
    ImageInput,
)
from hmt_ros.sessions.overlay import draw_modes, draw_notes
from hmt_ros.sessions.people_inputs import Found, PeopleReader
from hmt_ros.sessions.session import PublishedTopic
from hmt_ros.sessions.track import BODIES, Seen, Track, person_of
from hmt_ros.sessions.track_messages import MAX_OVERLAY_MODES, TOPICS_OF_NODE, notes_of
from hmt_ros.sessions.track_start import TrackStart
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.tracking import Status
from hmt_ros.tracking.settings import LIKELY_NATS
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    PEOPLE_2D,
    DetectedPerson,
    people_message,
)
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.images import compressed_image_message
from msg_tools.messages.markers import skeleton_markers

PEOPLE, MARKERS, OVERLAY = 'people', 'markers', 'overlay/compressed'


def published_topic(topic: str) -> PublishedTopic:
    """Return type and durability of a topic of the node or of a person."""
    if topic in PeopleSession.TOPICS:
        return PeopleSession.TOPICS[topic]
    return TOPICS_OF_NODE[topic.removeprefix(f'{BODIES}/{person_of(topic)}/')]


def session_of(parameters: FilterParameters) -> type[TrackingSession]:
    """Return the session class for the parameters of one person or of several people."""
    return PeopleSession if isinstance(parameters, PeopleParameters) else TrackingSession


# Minimum width and height of a detection that starts a track, px.
MIN_SIZE = 4
# Time after which a person with neither a track nor a new detection is dropped, s.
MAX_UNSTARTED_TIME = 0.5


@dataclass(frozen=True)
class PeopleState(CameraState):
    """State of the node: its status is 'no camera', 'waiting', 'nobody' or 'tracking'.

    Attributes:
        people: identities of the people who are tracked.
        followed: identities of the people who are tracked or whose track has not begun yet.
        detected: number of people in the last detections.
    """

    people: tuple[str, ...] = ()
    followed: tuple[str, ...] = ()
    detected: int = 0

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{len(self.people)} of {self.detected} people'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [('people', ' '.join(self.people)), ('people detected', str(self.detected))]


class _Person(Track):
    """A person who is followed; see `Track`.

    Args:
        found: first detection of the person.
        stamp: stamp of the image of the first detection, ns.

    Attributes:
        known_as: identity given by the detector; '' without an identity.
        place: track of the person's detections in the image.
    """

    def __init__(self, found: Found, stamp: int, *track: Any) -> None:
        self.known_as = found.detected.name
        self.place = ImageTrack(found.sighting, stamp)
        super().__init__(*track)

    @property
    def depth(self) -> float:
        """Distance of the person along the optical axis, m; infinite without a track."""
        return (
            float(self.tracker.estimate.modes.poses[0, 2])
            if self.begun and self.tracker
            else np.inf
        )

    def area(self, camera: Camera, shift: Array | None = None) -> Mask | None:
        """Mask (H, W) of the body in its likely modes, shifted by (2,) px; None without a track."""
        if not self.begun or self.tracker is None:
            return None
        modes = self.tracker.estimate.modes
        result = np.zeros((camera.height, camera.width), dtype=np.bool_)
        for pose in modes.poses[modes.log_weights > -LIKELY_NATS]:
            result |= covered(self.tracker.estimate.body, camera, pose)
        return grown(result if shift is None else moved(result, shift))

    def expected_area(self, camera: Camera, one: Found | None, stamp: int) -> Mask:
        """Mask (H, W) of the pixels that the person is expected to cover.

        Args:
            one: detection of the person in the image; None if the person was not detected.
        """
        shift = self.place.shift(stamp)
        if one is not None and self.begun and self.tracker is not None:
            body = self.tracker.estimate.body
            pixels = camera.project(body.joint_positions(self.tracker.estimate.modes.poses[:1]))[0]
            names = dict(zip(body.joint_names, pixels, strict=True))
            shifts = Sighting(names, one.sighting.corners).shifts_to(one.sighting)
            shift = np.nan_to_num(np.median(shifts, axis=0))
        area = self.area(camera, shift)
        return hull(self.place.sighting, (camera.height, camera.width)) if area is None else area


class PeopleSession(TrackingSession):
    """Tracks several people; see `TrackingSession` for arguments and attributes."""

    # Each person also has the topics of `track_messages`, with the prefix from `track.topic_of`.
    TOPICS: ClassVar[Mapping[str, PublishedTopic]] = {
        PEOPLE: PublishedTopic(PEOPLE_2D),
        **{topic: TOPICS_OF_NODE[topic] for topic in ('/tf', MARKERS, OVERLAY)},
    }
    ESTIMATE = 'every track'
    CHECKED = ('background_file', 'body_model', 'lifter')

    parameters: PeopleParameters
    tracks: Sequence[_Person]

    def _set_up(self) -> None:
        self._reader = PeopleReader(self.parameters, self._log)
        super()._set_up()

    def _begin(self) -> None:
        self.tracks = ()
        self._scene: Silhouettes | None = None
        self._watch = SceneWatch()
        self._next, self._detected, self._begun = 1, 0, False
        # People whose markers are shown.
        self._marked: tuple[str, ...] = ()

    def restart(self, start: TrackStart | None = None) -> None:
        """See `TrackingSession`."""
        self._begin()
        super().restart(start)

    # Inputs.

    @classmethod
    def inputs_of(cls, parameters: FilterParameters) -> tuple[ImageInput, ...]:
        """See `CameraSession`."""
        detections = {DETECTIONS: SOURCES[parameters.source]}
        return replace(DETECTIONS_INPUT, types=detections), DEPTH_INPUT, MASK_INPUT

    def _read_input(self, row: ImageInput, message: Any, stamp: int) -> Any:
        if row.name == DETECTIONS:
            return self._reader.people(message, stamp)
        return super()._read_input(row, message, stamp)

    # Estimates.

    def _people_in(self, waiting: WaitingImage, camera: Camera) -> Iterator[tuple[Track, Seen]]:
        p, stamp = self.parameters, waiting.stamp_ns
        detected: list[DetectedPerson] | None = waiting.content(DETECTIONS)
        if self._scene is None:
            self._scene = Silhouettes(self._background_for(camera))
        if (pose := self.frames.pose) is not None:
            # The background depends on the pose of the camera.
            self._scene.set_camera_pose(CameraPose.of(pose.translation, pose.rotation), camera)
        found: list[Found] = []
        if detected is not None:
            found = self._reader.found(
                detected, self.start.body, p.keypoint_scheme, use_keypoints=p.use_keypoints
            )
        own, left = self._matched(found, stamp)
        known = self._scene.scene.known
        background = self._scene.background if known else BackgroundModel()
        self._start_tracks(left, own, camera, background, stamp)
        if detected is not None:
            self._detected = len(detected)
            if not detected and not self.tracks:
                self._scene.learn(waiting.image, stamp, detected=False)
        if self._scene.scene.known:
            self._look_at_scene(waiting, self._scene.background, 'call ~/reset')
        yield from self._nearest_first(waiting, camera, own, left, detected is not None)
        self._drop_lost_people(stamp)
        if detected is not None:
            if self._wanted(PEOPLE):
                self._publish_people(waiting, camera)
            self._show_people(waiting, camera)
        self._begun = True

    def _background_for(self, camera: Camera) -> BackgroundModel:
        try:
            return self.start.background_model(camera)
        except ValueError as error:
            self._log.note('background', f'{error}: silhouettes are not used')
            self.start = replace(self.start, background=None)
            return BackgroundModel()

    def _matched(
        self, found: Sequence[Found], stamp: int
    ) -> tuple[dict[_Person, Found], list[Found]]:
        """Return the detections by followed person, and the detections that match nobody."""
        named = {one.detected.name: one for one in found if one.detected.name}
        own = {x: named[x.known_as] for x in self.tracks if x.known_as in named}
        left = [one for one in found if one not in own.values()]
        others = [person for person in self.tracks if person not in own]
        pairs = assigned([x.place for x in others], [x.sighting for x in left], stamp)
        for row, column in pairs.items():
            own[others[row]] = left[column]
        left = [one for i, one in enumerate(left) if i not in pairs.values()]
        for person, one in own.items():
            person.known_as = one.detected.name or person.known_as
            person.place.update(one.sighting, stamp)
        return own, left

    def _start_tracks(
        self,
        left: list[Found],
        own: dict[_Person, Found],
        camera: Camera,
        background: BackgroundModel,
        stamp: int,
    ) -> None:
        """Starts tracks from the largest unmatched detections, and moves these to `own`."""
        p, size = self.parameters, (camera.width, camera.height)
        for one in sorted(left, key=lambda x: -x.sighting.size):
            corners = np.clip(np.rint(one.sighting.corners), 0, size).astype(int)
            if not one.suffices or (corners[1] - corners[0]).min() < MIN_SIZE:
                continue
            costs = [x.place.cost(one.sighting, stamp) for x in own if own[x] is not one]
            if min(costs, default=GATE_COST) < 0.5 * GATE_COST:
                continue  # a second detection of the same person
            if len(self.tracks) >= p.max_people:
                self._log.note(
                    'too many people',
                    f'{len(own) + len(left)} people are detected in the image of {stamp} ns, but '
                    f'max_people is {p.max_people}: the others are not followed',
                )
                return
            start = self.start
            if not one.keypoints.names:
                start = replace(start, box=(*corners[0].tolist(), *corners[1].tolist()))
            name = self._new_name(one.detected.name)
            person = _Person(one, stamp, name, p, start, self._shared, background)
            self.tracks = (*self.tracks, person)
            own[person] = one
            left.remove(one)

    def _new_name(self, given: str) -> str:
        """Return an unused identity that is valid in topics: [A-Za-z] first, then [A-Za-z0-9_]."""
        taken = {track.person for track in self.tracks}
        name = re.sub(r'[^A-Za-z0-9_]', '_', given)
        if name:
            name = name if name[0].isalpha() else f'p{name}'
        while not name or name in taken:
            name = f'p{self._next}'
            self._next += 1
        return name

    def _nearest_first(
        self,
        waiting: WaitingImage,
        camera: Camera,
        own: dict[_Person, Found],
        strangers: Sequence[Found],
        answered: bool,
    ) -> Iterator[tuple[Track, Seen]]:
        """Yields the tracks, nearest first, with the pixels that other people cover."""
        shape = waiting.image.shape[:2]
        areas = {
            person: person.expected_area(camera, own.get(person), waiting.stamp_ns)
            for person in self.tracks
        }
        strange = [hull(one.sighting, shape) for one in strangers]
        order = sorted(self.tracks, key=lambda person: person.depth)
        for place, person in enumerate(order):
            nearer = [areas[other] for other in order[:place]]
            farther = [areas[other] for other in order[place + 1 :]]
            others = unknown_area(areas[person], [*nearer, *strange], farther)
            one, keypoints = own.get(person), None
            if one is not None and one.keypoints.names:
                keypoints = one.keypoints
            elif answered and one is None and person.place.sighting.joints:
                keypoints = NO_KEYPOINTS
            yield person, Seen(keypoints, others=others)
            if (area := person.area(camera)) is not None:
                areas[person] = area

    def _drop_lost_people(self, stamp: int) -> None:
        self.tracks = tuple(
            person
            for person in self.tracks
            if person.status is not Status.NOBODY
            and (person.begun or stamp - person.place.stamp <= MAX_UNSTARTED_TIME * SECOND_NS)
        )

    def _publish_people(self, waiting: WaitingImage, camera: Camera) -> None:
        people = []
        for person in self.tracks:
            tracker = person.tracker
            if tracker is None or not person.begun:
                continue
            names, pose = tracker.estimate.body.joint_names, tracker.estimate.point_estimate[None]
            pixels = camera.project(tracker.estimate.body.joint_positions(pose))[0]
            unknown = np.full((len(names), 2, 2), np.nan)
            keypoints = Keypoints(names, pixels, unknown, np.ones(len(names)))
            box = region_of(tracker.estimate.body, camera, pose, margin=0.0)
            people.append(DetectedPerson(person.person, keypoints, box))
        stamp, frame = waiting.stamp_ns, waiting.frame_id
        self._publish(PEOPLE, stamp, people_message(self._messages, people, stamp, frame))

    def _show_people(self, waiting: WaitingImage, camera: Camera) -> None:
        """Publishes markers and an overlay with all people, if they have subscribers."""
        if not (self._wanted(MARKERS) or self._wanted(OVERLAY)):
            return
        stamp, frame = waiting.stamp_ns, waiting.frame_id
        tracked = {x.person: x.tracker for x in self.tracks if x.begun and x.tracker is not None}
        body = self.start.body
        names, bones = body.joint_names, body.skeleton.bones
        modes = {
            person: (x.estimate.body.joint_positions(x.estimate.modes.poses), x.estimate.modes)
            for person, x in tracked.items()
        }
        if self._wanted(MARKERS):
            edges = [(names[a], names[b]) for a, b in bones]
            nobody = np.empty((0, len(names), 3)), np.empty(0)
            ranks = self.parameters.tracker.max_hypotheses
            array = None
            for person in dict.fromkeys((*self._marked, *modes)):
                joints, weights = nobody
                if person in modes:
                    joints, weights = modes[person][0], elementary.exp(modes[person][1].log_weights)
                own = skeleton_markers(
                    self._messages, joints, names, edges, weights, stamp, frame,
                    ranks=ranks, namespace=person,
                )  # fmt: skip
                if array is None:
                    array = own
                else:
                    array.markers += own.markers
            self._marked = tuple(modes)
            if array is not None:
                self._publish(MARKERS, stamp, array)
        if self._wanted(OVERLAY):
            picture = waiting.image
            for joints, found in modes.values():
                weights = elementary.exp(found.log_weights)
                picture = draw_modes(picture, camera, joints, bones, weights, MAX_OVERLAY_MODES)
            notes = [f'{len(modes)} of {self._detected} people', *notes_of(self.parameters)]
            message = compressed_image_message(
                self._messages, draw_notes(picture, notes), stamp, frame
            )
            self._publish(OVERLAY, stamp, message)

    # State.

    def _present_state(self) -> PeopleState:
        return PeopleState(
            *self._status_and_wants(),
            **self._totals(),
            people=tuple(track.person for track in self.tracks if track.begun),
            followed=tuple(track.person for track in self.tracks),
            detected=self._detected,
            moved=self._watch.moved,
        )

    def _status(self) -> tuple[str, str]:
        if not self._begun:
            return 'waiting', 'an image and its detections'
        return ('tracking' if any(track.begun for track in self.tracks) else 'nobody'), ''
