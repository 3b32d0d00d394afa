"""Several people before one camera: detections in, one filter for each person.

The rules, besides those of `TrackingSession`:

- An image waits for its detections (`image_inputs`).
- Identities of the detector are kept. People without one are told apart by their last place
  and motion (`hmt_ros.tracking.association`).
- A detection that matches nobody who is followed starts a filter, the largest first, up to
  `max_people`. A person without a track, or no longer in view (`Tracker.status`), is dropped.
- The nearest person is tracked first. For each person the pixels of nearer people are unknown, and
  the pixels that only somebody farther away covers (`Tracker.step`, others).
- The background is learned while nobody is detected, or read from `background_file`.
- With every image whose detections are known a list of the people who are tracked goes out.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.image.background import BackgroundModel, SceneWatch
from hmt_ros.image.silhouettes import Silhouettes, region_of
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Mask
from hmt_ros.sessions.camera_session import CAMERA_MOVED, WaitingImage
from hmt_ros.sessions.handled import Fault, Output
from hmt_ros.sessions.image_inputs import (
    DEPTH_INPUT,
    DETECTIONS,
    DETECTIONS_INPUT,
    MASK_INPUT,
    SOURCES,
    ImageInput,
)
from hmt_ros.sessions.people_inputs import Found, PeopleReader
from hmt_ros.sessions.people_parameters import PeopleParameters
from hmt_ros.sessions.person_session import BODIES, PersonSession, person_of
from hmt_ros.sessions.session import PublishedTopic, SessionState
from hmt_ros.sessions.track_messages import TOPICS_OF_NODE
from hmt_ros.sessions.tracking_session import TrackingSession
from hmt_ros.tracking.association import (
    GATE,
    ImageTrack,
    Sighting,
    assigned,
    grown,
    hull,
    unknown_area,
)
from hmt_ros.tracking.camera_motion import CameraPose
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    PEOPLE_2D,
    DetectedPerson,
    people_message,
)
from msg_tools.messages.headers import SECOND_NS

PEOPLE = 'people'


def published_topic(topic: str) -> PublishedTopic:
    """Type and durability of a topic of the node or of a person."""
    if topic in PeopleSession.TOPICS:
        return PeopleSession.TOPICS[topic]
    return TOPICS_OF_NODE[topic.removeprefix(f'{BODIES}/{person_of(topic)}/')]


# Least size in the image, px, of a person who is tracked.
SMALLEST = 4
# Time, s, after which a person who is no longer detected and has no track yet is forgotten.
UNSTARTED = 0.5


@dataclass(frozen=True)
class PeopleState(SessionState):
    """State of the node: its status is 'no camera', 'waiting', 'nobody' or 'tracking'.

    Attributes:
        people: identities of those who are tracked.
        followed: identities of those who are tracked, or about to be.
        detected: number of people in the last detections.
        moved: whether the camera has moved since the background was taken.
    """

    people: tuple[str, ...] = ()
    followed: tuple[str, ...] = ()
    detected: int = 0
    moved: bool = False

    def summary(self) -> str:
        """The present estimate in a few words."""
        return f'{len(self.people)} of {self.detected} people'

    def trouble(self) -> str:
        """Whether the background is of no use."""
        return CAMERA_MOVED if self.moved else ''

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [('people', ' '.join(self.people)), ('people detected', str(self.detected))]


@dataclass(eq=False)
class _Person:
    """Somebody who is followed.

    Attributes:
        name: identity in topics.
        known_as: identity that the detector gives; '' if it gives none.
        place: where the person was last detected.
        session: with the track.
    """

    name: str
    known_as: str
    place: ImageTrack
    session: PersonSession


class PeopleSession(TrackingSession[PeopleParameters, PeopleState]):
    """Tracks several people; see `TrackingSession` for arguments and attributes."""

    # Each person has those of `track_messages` besides, with the prefix of `person_session`.
    TOPICS: ClassVar[Mapping[str, PublishedTopic]] = {
        PEOPLE: PublishedTopic(PEOPLE_2D),
        '/tf': TOPICS_OF_NODE['/tf'],
    }
    ESTIMATE = 'every track'
    CHECKED = ('background_file', 'body_model', 'lifter')

    def _set_up(self) -> None:
        super()._set_up()
        self._used = self.parameters
        self._reader = PeopleReader(self._used, self._log)
        self._forget()
        self.state = self._present_state()

    @classmethod
    def inputs_of(cls, parameters: PeopleParameters) -> tuple[ImageInput, ...]:
        """See `CameraSession`."""
        detections = {DETECTIONS: SOURCES[parameters.source]}
        return replace(DETECTIONS_INPUT, types=detections), DEPTH_INPUT, MASK_INPUT

    def _forget(self) -> None:
        self._people: list[_Person] = []
        self._scene: Silhouettes | None = None
        self._watch = SceneWatch()
        self._next, self._detected, self._begun = 1, 0, False

    def stale(self, silence: float, answered: int) -> list[Output]:
        """See `TrackingSession`; of everybody who is followed."""
        if answered != self.answered:
            return []
        people = [person.session for person in self._people]
        return [output for one in people for output in one.stale(silence, one.answered)]

    # Inputs.

    def _read_input(self, row: ImageInput, message: Any, stamp: int) -> Any:
        if row.name == DETECTIONS:
            return self._reader.people(message, stamp, self.parameters.keypoint_sigma_px)
        return super()._read_input(row, message, stamp)

    # Estimates.

    def _estimate(self, waiting: WaitingImage, camera: Camera) -> None:
        stamp = waiting.stamp_ns
        detected: list[DetectedPerson] | None = waiting.content(DETECTIONS)
        self._look_at_frames(waiting)
        if self._scene is None:
            self._scene = Silhouettes(self._background_for(camera))
        if (pose := self.frames.pose) is not None:
            # From another view the scene is another.
            self._scene.see_from(CameraPose.of(pose.translation, pose.rotation), camera)
        p, found = self.parameters, []
        if p is not self._used:
            self._used = p
            for person in self._people:
                person.session.use(p)
        if detected is not None:
            found = self._reader.found(
                detected, self.start.body, p.keypoint_scheme, use_keypoints=p.use_keypoints
            )
        own, left = self._matched(found, stamp)
        known = self._scene.scene.known
        background = self._scene.background if known else BackgroundModel(p.background)
        self._begin(left, own, camera, background, stamp)
        if detected is not None:
            self._detected = len(detected)
            if not detected and not self._people:
                self._scene.learn(waiting.image, stamp, detected=False)
        if self._scene.scene.known:
            self._look_at_scene(waiting, self._scene.background, 'call ~/reset')
        skipped, tracked = self._log.counts['skipped'], self._log.counts['tracked']
        self._follow_all(waiting, camera, own, left, answered=detected is not None)
        self.answered += 1
        # Those are counts of images, not of people.
        any_tracked = self._log.counts['tracked'] > tracked
        any_skipped = self._log.counts['skipped'] > skipped and not any_tracked
        self._log.counts['tracked'] = tracked + any_tracked
        self._log.counts['skipped'] = skipped + any_skipped
        self._drop_those_who_left(stamp)
        if detected is not None and self._wanted(PEOPLE):
            self._publish_people(waiting, camera)
        self._begun = True

    def _background_for(self, camera: Camera) -> BackgroundModel:
        try:
            return self.start.background_model(camera)
        except ValueError as error:
            self._log.note(Fault.BACKGROUND, f'{error}: silhouettes are not used')
            self.start = replace(self.start, background=None)
            return BackgroundModel(self.parameters.background)

    def _matched(
        self, found: Sequence[Found], stamp: int
    ) -> tuple[dict[_Person, Found], list[Found]]:
        """Detections of the people who are followed, by person, and the detections left over."""
        own: dict[_Person, Found] = {}
        left = list(found)
        for person in self._people:
            for one in left:
                if person.known_as and one.detected.name == person.known_as:
                    own[person] = one
                    left.remove(one)
                    break
        others = [person for person in self._people if person not in own]
        pairs = assigned([x.place for x in others], [x.sighting for x in left], stamp)
        for row, column in pairs.items():
            own[others[row]] = left[column]
        left = [one for i, one in enumerate(left) if i not in pairs.values()]
        for person, one in own.items():
            person.known_as = one.detected.name or person.known_as
            person.place.update(one.sighting, stamp)
        return own, left

    def _begin(
        self,
        left: list[Found],
        own: dict[_Person, Found],
        camera: Camera,
        background: BackgroundModel,
        stamp: int,
    ) -> None:
        """Follows the largest of the detections left over; they move from `left` to `own`."""
        p, size = self.parameters, (camera.width, camera.height)
        for one in sorted(left, key=lambda x: -x.sighting.size):
            corners = np.clip(np.rint(one.sighting.corners), 0, size).astype(int)
            if not one.suffices or (corners[1] - corners[0]).min() < SMALLEST:
                continue
            costs = [x.place.cost(one.sighting, stamp) for x in own if own[x] is not one]
            if min(costs, default=GATE) < 0.5 * GATE:
                continue  # a second detection of the same person
            if len(self._people) >= p.max_people:
                self._log.note(
                    Fault.PEOPLE,
                    f'{len(own) + len(left)} people are detected in the image of {stamp} ns, but '
                    f'max_people is {p.max_people}: the others are not followed',
                )
                return
            name = self._new_name(one.detected.name)
            session = PersonSession(
                name,
                p,
                self._publish_output,
                self._wanted,
                self.start,
                background,
                self.frames,
                self._log,
            )
            if not one.keypoints.names:
                session.start_in((*corners[0].tolist(), *corners[1].tolist()))
            person = _Person(name, one.detected.name, ImageTrack(one.sighting, stamp), session)
            self._people.append(person)
            own[person] = one
            left.remove(one)

    def _new_name(self, given: str) -> str:
        """Identity for topics: letters, digits and underscores, a letter first."""
        taken = {person.name for person in self._people}
        name = re.sub(r'[^A-Za-z0-9_]', '_', given)
        if name:
            name = name if name[0].isalpha() else f'p{name}'
        while not name or name in taken:
            name = f'p{self._next}'
            self._next += 1
        return name

    def _follow_all(
        self,
        waiting: WaitingImage,
        camera: Camera,
        own: dict[_Person, Found],
        strangers: Sequence[Found],
        *,
        answered: bool,
    ) -> None:
        """Tracks everybody in an image, the nearest first."""
        stamp, shape = waiting.stamp_ns, waiting.image.shape[:2]
        areas = {
            person: self._area(person, camera, own.get(person), shape, stamp)
            for person in self._people
        }
        strange = [hull(one.sighting, shape) for one in strangers]
        order = sorted(self._people, key=lambda x: x.session.depth)
        for place, person in enumerate(order):
            nearer = [areas[other] for other in order[:place]]
            farther = [areas[other] for other in order[place + 1 :]]
            others = unknown_area(areas[person], [*nearer, *strange], farther)
            one, keypoints = own.get(person), None
            if one is not None and one.keypoints.names:
                keypoints = one.keypoints
            elif answered and one is None and person.place.sighting.joints:
                keypoints = NO_KEYPOINTS
            person.session.follow(waiting, camera, keypoints, others)
            seen = person.session.area(camera)
            if seen is not None:
                areas[person] = grown(seen)

    def _area(
        self,
        person: _Person,
        camera: Camera,
        one: Found | None,
        shape: tuple[int, ...],
        stamp: int,
    ) -> Mask:
        """Pixels (H, W) that a person is expected to cover."""
        tracker = person.session.tracker
        if not person.session.begun or tracker is None:
            return hull(person.place.sighting, shape)
        shift = person.place.shift(stamp)
        if one is not None:
            pixels = camera.project(
                tracker.estimate.body.joint_positions(tracker.estimate.modes.poses[:1])
            )[0]
            names = tracker.estimate.body.joint_names
            seen = Sighting(dict(zip(names, pixels, strict=True)), one.sighting.corners)
            shift = np.nan_to_num(np.median(seen.shifts_to(one.sighting), axis=0))
        area = person.session.area(camera, shift)
        assert area is not None
        return grown(area)

    def _drop_those_who_left(self, stamp: int) -> None:
        self._people = [
            person
            for person in self._people
            if not person.session.ended
            and (person.session.begun or stamp - person.place.stamp <= UNSTARTED * SECOND_NS)
        ]

    def _publish_people(self, waiting: WaitingImage, camera: Camera) -> None:
        people = []
        for person in self._people:
            tracker = person.session.tracker
            if tracker is None or not person.session.begun:
                continue
            names, pose = tracker.estimate.body.joint_names, tracker.estimate.point_estimate[None]
            pixels = camera.project(tracker.estimate.body.joint_positions(pose))[0]
            unknown = np.full((len(names), 2, 2), np.nan)
            keypoints = Keypoints(names, pixels, unknown, np.ones(len(names)))
            box = region_of(tracker.estimate.body, camera, pose, margin=0.0)
            people.append(DetectedPerson(person.name, keypoints, box))
        stamp, frame = waiting.stamp_ns, waiting.frame_id
        self._publish(PEOPLE, stamp, people_message(self._messages, people, stamp, frame))

    # State.

    def _present_state(self) -> PeopleState:
        return PeopleState(
            *self._status_and_wants(),
            **self._totals(),
            people=tuple(person.name for person in self._people if person.session.begun),
            followed=tuple(person.name for person in self._people),
            detected=self._detected,
            moved=self._watch.moved,
        )

    def _status(self) -> tuple[str, str]:
        if not self._begun:
            return 'waiting', 'an image and its detections'
        return ('tracking' if any(x.session.begun for x in self._people) else 'nobody'), ''
