"""Several people before one camera: detections in, one filter for each person.

The rules, besides those of `CameraSession`:

- An image waits for the detections of exactly its stamp, for detections of a later stamp, or for an
  image that is `input_timeout` younger.
- Somebody to whom the detector gives an identity keeps it. Others are told apart by where they were
  last and how they moved (`hmt_ros.tracking.association`).
- A detection of nobody who is followed starts a filter, the largest first, up to `max_people`. Whom
  no track has, or who is no longer in view (`Tracker.status`), is not followed any more.
- The nearest person is tracked first. To everybody the pixels of those who are nearer are unknown,
  and the pixels that only somebody farther away covers (`Tracker.step`, others).
- The background is learned while nobody is detected, or read from `background_file`.
- With every image whose detections are known a list of the people who are tracked goes out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.image.background import BackgroundModel
from hmt_ros.image.scene_watch import SceneWatch
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.inference.arrays import Mask
from hmt_ros.sessions.camera_frames import CameraFrames
from hmt_ros.sessions.camera_session import (
    IMAGE,
    CameraSession,
    StampedInputs,
    WaitingImage,
)
from hmt_ros.sessions.depth_inputs import DEPTH, DepthInputs
from hmt_ros.sessions.handled import Fault, Handled, Output
from hmt_ros.sessions.people_inputs import Found, PeopleInputs
from hmt_ros.sessions.people_parameters import PeopleParameters
from hmt_ros.sessions.people_state import PeopleState
from hmt_ros.sessions.person_session import BODIES, PersonSession, person_of
from hmt_ros.sessions.session import NeededInput, PublishedTopic, everything
from hmt_ros.sessions.track_messages import TOPICS_OF_NODE
from hmt_ros.sessions.track_start import TrackStart, prepare_start
from hmt_ros.sessions.transform_buffer import TF_STATIC, TRANSFORMS
from hmt_ros.sessions.warm_up import warm_up_tracking
from hmt_ros.tracking.areas import grown, hull, unknown_area
from hmt_ros.tracking.association import GATE, ImageTrack, Sighting, assigned
from hmt_ros.tracking.camera_motion import CameraPose
from hmt_ros.tracking.silhouettes import Silhouettes, region_of
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    PEOPLE_2D,
    DetectedPerson,
    people_message,
    stamp_of_floats,
)
from msg_tools.messages.headers import SECOND_NS, time_ns

DETECTIONS, PEOPLE = 'detections', 'people'
__all__ = ['DETECTIONS', 'IMAGE', 'PEOPLE', 'PeopleSession', 'PeopleState']


def published_topic(topic: str) -> PublishedTopic:
    """What is published on a topic of the node or of a person."""
    if topic in PeopleSession.TOPICS:
        return PeopleSession.TOPICS[topic]
    return TOPICS_OF_NODE[topic.removeprefix(f'{BODIES}/{person_of(topic)}/')]


# Less of somebody in the image, px, is not worth a track.
SMALLEST = 4
# Somebody who is detected no more, and of whom no track has started, is forgotten after so long, s.
UNSTARTED = 0.5


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


class PeopleSession(CameraSession[PeopleParameters, PeopleState]):
    """Tracks several people; see `Session` for arguments and attributes.

    Attributes:
        frames: that transforms lead to from the camera.
        answered: number of images of which a robot was told.
    """

    # Each person has those of `track_messages` besides, with the prefix of `person_session`.
    TOPICS: ClassVar[Mapping[str, PublishedTopic]] = {
        PEOPLE: PublishedTopic(PEOPLE_2D),
        '/tf': TOPICS_OF_NODE['/tf'],
    }
    DONE = 'tracked'
    ESTIMATE = 'every track'
    CHECKED = ('background_file', 'body_model', 'lifter')

    def __init__(
        self,
        parameters: PeopleParameters,
        publish: Callable[[Output], None],
        wanted: Callable[[str], bool] = everything,
    ) -> None:
        super().__init__(parameters, publish, wanted)
        p = parameters
        self._source = p.source
        self._inputs = PeopleInputs(p, self._log)
        self.frames = CameraFrames(p.gravity_frame, p.fixed_frame, floor=p.floor_in_gravity_frame)
        self._start = prepare_start(p)
        self._detections: StampedInputs[list[DetectedPerson]] = StampedInputs()
        self._depths = DepthInputs(self._log)
        self._info_stamp = self.answered = 0
        self._forget()
        self.state = self._present_state()

    def prepare(self) -> None:
        """See `Session`."""
        warm_up_tracking()

    def restart(self, start: TrackStart | None = None) -> None:
        """Drops all tracks; people start anew.

        Args:
            start: what they start from; None: what the parameters name.

        Raises:
            ValueError: the parameters name a file that can not be used; the tracks go on.
        """
        self._start = prepare_start(self.parameters) if start is None else start
        super().restart()

    def finish(self) -> Handled:
        """Tracks the images that wait for inputs, which do not come any more."""
        self._log.begin()
        while self._waiting and self._camera is not None:
            self._estimate_next(self._camera)
        return self._handled('finish', 0 if self._newest is None else self._newest)

    def _forget(self) -> None:
        self._people: list[_Person] = []
        self._scene: Silhouettes | None = None
        self._watch = SceneWatch()
        self._next, self._detected, self._begun = 1, 0, False

    def stale(self, silence: float) -> list[Output]:
        """As `FilterSession.stale`, of everybody who is followed."""
        return [output for person in self._people for output in person.session.stale(silence)]

    def _start_anew(self) -> None:
        try:
            self.restart()
        except ValueError as error:
            self._log.fault(Fault.START, f'{error}; all tracks start as the time before')
            self._start_again()

    def _start_again(self) -> None:
        super().restart()

    def needed_inputs(self) -> list[NeededInput]:
        """What has to come at present; may be called by any thread."""
        needed = [*super().needed_inputs(), NeededInput((DETECTIONS,), with_each=True)]
        if self.parameters.use_depth:
            needed.append(NeededInput((DEPTH,), with_each=True))
        if self.frames.wanted and not self.frames.heard:
            needed.append(NeededInput(TRANSFORMS))
        return needed

    # Inputs.

    def _stamp_of(self, source: str, message: Any) -> int:
        if source in TRANSFORMS:
            return max((time_ns(each.header.stamp) for each in message.transforms), default=0)
        if source == DETECTIONS and self._source == 'floats':
            told = stamp_of_floats(message)
            return self._info_stamp if told is None else told
        return super()._stamp_of(source, message)

    def _take(self, source: str, message: Any, stamp: int) -> None:
        if source == DETECTIONS:
            people = self._inputs.people(message, stamp, self.parameters.keypoint_sigma_px)
            self._detections.put(stamp, people)
        elif source == DEPTH:
            if self.parameters.use_depth:
                self._depths.put(message, stamp)
        elif source in TRANSFORMS:
            if self.frames.wanted:
                for text in self.frames.take(message, static=source == TF_STATIC):
                    self._log.note(Fault.TRANSFORM, text)
        else:
            super()._take(source, message, stamp)

    def _take_camera_info(self, message: Any) -> None:
        self._info_stamp = time_ns(message.header.stamp)
        super()._take_camera_info(message)

    def _forget_inputs(self, stamp: int) -> None:
        super()._forget_inputs(stamp)
        self._detections.clear()
        self._depths.images.clear()
        self.frames.forget_after(stamp)

    def _waits_for_inputs(self) -> bool:
        return True

    def _is_ready(self, waiting: WaitingImage) -> bool:
        timeout = self.parameters.input_timeout
        return (
            super()._is_ready(waiting)
            and self._has(self._detections, waiting.stamp_ns, timeout)
            and self._has_depth(waiting.stamp_ns)
            and self._has_transforms(self.frames, waiting)
        )

    def _missing_input(self, stamp: int) -> Fault:
        p = self.parameters
        if not self._has(self._detections, stamp, p.input_timeout):
            return Fault.NO_DETECTIONS
        if not self._has_depth(stamp):
            return Fault.NO_DEPTH
        return super()._missing_input(stamp)

    def _has_depth(self, stamp: int) -> bool:
        p = self.parameters
        return not p.use_depth or self._has(self._depths.images, stamp, p.input_timeout)

    # Estimates.

    def _estimate(self, waiting: WaitingImage, camera: Camera) -> None:
        stamp = waiting.stamp_ns
        for each in self._detections.before(stamp):
            if each in self._dropped:
                continue
            self._log.note(
                Fault.LONE_DETECTIONS,
                f'detections of {each} ns belong to no image, or come too late: wanted the stamp '
                'of an image',
            )
        detected = self._detections.take(stamp)
        if detected is None:
            self._log.note(
                Fault.NO_DETECTIONS, f'no detections have come for the image of {stamp} ns'
            )
        if self.parameters.use_depth:
            waiting = self._depths.added_to(waiting, self._dropped)
        for kind, text in self.frames.look(waiting.frame_id, stamp):
            self._log.note(kind, text)
        if self._scene is None:
            self._scene = Silhouettes(self._background_for(camera))
        if (pose := self.frames.pose) is not None:
            # From another view the scene is another.
            self._scene.see_from(CameraPose.of(pose.translation, pose.rotation), camera)
        p, found = self.parameters, []
        if detected is not None:
            found = self._inputs.found(
                detected, self._start.body, p.keypoint_scheme, use_keypoints=p.use_keypoints
            )
        own, left = self._matched(found, stamp)
        self._begin(left, own, camera, self._scene.background, stamp)
        if detected is not None:
            self._detected = len(detected)
            if not detected and not self._people:
                self._scene.learn(waiting.image, None)
        if self._scene.background.frames:
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
            return self._start.background_model(camera)
        except ValueError as error:
            self._log.note(Fault.BACKGROUND, f'{error}: silhouettes are not used')
            self._start = replace(self._start, background=None)
            return BackgroundModel(self.parameters.background)

    def _matched(
        self, found: Sequence[Found], stamp: int
    ) -> tuple[dict[_Person, Found], list[Found]]:
        """What is found of everybody who is followed, and those whom nobody follows."""
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
        """Follows the largest of those whom nobody follows; they move from `left` to `own`."""
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
                name, p, self._publish_output, self._wanted, self._start,
                background, self.frames, self._log,
            )  # fmt: skip
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
        self, person: _Person, camera: Camera, one: Found | None, shape: tuple[int, ...],
        stamp: int,
    ) -> Mask:  # fmt: skip
        """Pixels (H, W) that a person is expected to cover."""
        tracker = person.session.tracker
        if not person.session.begun or tracker is None:
            return hull(person.place.sighting, shape)
        shift = person.place.shift(stamp)
        if one is not None:
            pixels = camera.project(tracker.body.joint_positions(tracker.modes.poses[:1]))[0]
            names = tracker.body.joint_names
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
            names, pose = tracker.body.joint_names, tracker.point_estimate[None]
            pixels = camera.project(tracker.body.joint_positions(pose))[0]
            unknown = np.full((len(names), 2, 2), np.nan)
            keypoints = Keypoints(names, pixels, unknown, np.ones(len(names)))
            box = region_of(tracker.body, camera, pose, margin=0.0)
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
