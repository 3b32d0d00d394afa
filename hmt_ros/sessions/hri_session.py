"""Session of the REP 155 bridge: mixtures of people in, bodies of REP 155 out.

The rules, in addition to those of `Session`:

- Each track of a person is a body. Its identity consists of the name of the person (the namespace
  without /humans/bodies/) and the number of the track: p1_2 is the second track in
  /humans/bodies/p1. A new track of the same person is a new body; no identity is used twice.
- /humans/bodies/tracked lists the bodies that are tracked. A body whose track is lost is not in the
  list until the same track is found again. A body ends with its track, with a mixture without
  components, or `MAX_SILENCE` after its last mixture.
- A body is shown in one pose, its heaviest mode. This mode is shown until it ends, or until another
  mode has more than twice its weight.
- Regions, landmarks and cropped images need a calibrated camera_info for the frame of the mixture;
  frames and joint states do not. A cropped image also needs the image with the mixture's stamp.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hmt_ros.body import Camera
from hmt_ros.body.reference_human import Joint, ReferenceHuman, fit_reference_human
from hmt_ros.inference.arrays import Array
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE, camera_info_fault
from hmt_ros.sessions.hri_parameters import HriParameters
from hmt_ros.sessions.session import (
    NeededInput,
    PublishedTopic,
    Session,
    SessionState,
)
from hmt_ros.sessions.stamp_order import Stamped, StampOrder
from msg_tools import MessageError
from msg_tools.messages.camera_info import CameraInfoError, camera_from_info
from msg_tools.messages.detections import SKELETON_2D
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.humans import (
    IDS,
    REGION,
    cropped_message,
    human_joint_states,
    human_transforms,
    human_urdf,
    ids_message,
    landmarks_in_space,
    region_in_image,
    region_message,
    skeleton_message,
)
from msg_tools.messages.images import ImageError
from msg_tools.messages.pose_mixtures import PoseMixture, TrackState, pose_mixture_of

BODIES = '/humans/bodies'
TRACKED, FRAMES = f'{BODIES}/tracked', '/tf'
TOPICS = {
    TRACKED: PublishedTopic(IDS, latched=True),
    FRAMES: PublishedTopic('tf2_msgs/msg/TFMessage'),
}
# Topics in the namespace of each body.
BODY_TOPICS = {
    'urdf': PublishedTopic('std_msgs/msg/String', latched=True),
    'joint_states': PublishedTopic('sensor_msgs/msg/JointState'),
    'roi': PublishedTopic(REGION),
    'skeleton2d': PublishedTopic(SKELETON_2D),
    'cropped': PublishedTopic('sensor_msgs/msg/Image'),
}
MIXTURE = 'pose_mixture'
# Minimum weight, relative to the heaviest mode, at which the shown mode is kept.
_MIN_RELATIVE_WEIGHT = 0.5
# Maximum change of a joint's origin without a new URDF, m.
_MAX_ORIGIN_CHANGE = 0.005
# Time without a mixture after which a body ends, by the stamps of camera_info, s.
MAX_SILENCE = 2.0
# Maximum number of absent people whose last body number is remembered.
_MAX_REMEMBERED_PEOPLE = 1000
# Number of images kept for cropping; a filter with a larger delay drops images itself.
_MAX_IMAGES = 20


def mixture_source(namespace: str) -> str:
    """Return the source name of the mixtures in a namespace."""
    return f'{MIXTURE} of {namespace}'


def body_topic(identity: str, name: str) -> str:
    """Return the topic of a body; `name` is one of `BODY_TOPICS`."""
    return f'{BODIES}/{identity}/{name}'


def published_topic(topic: str) -> PublishedTopic:
    """Return type and durability of a topic of the session."""
    return TOPICS.get(topic) or BODY_TOPICS[topic.rpartition('/')[2]]


@dataclass
class _Person:
    """The person of one namespace of mixtures, and the body that is tracked there.

    Attributes:
        name: name of the person.
        identity: identity of the body; '' without a body.
        tracked: whether the body is listed as tracked: it is neither lost nor ended.
        track: number of the body's track; 0: unnumbered.
        bodies: number of the person's newest body, which is part of the body's identity.
        heard: time of the last mixture, by the stamps of camera_info, ns.
        mode: identity of the mode that is shown; 0: none.
        angles: angles of the reference model in the previous image.
        described: joints in the last published URDF.
    """

    name: str
    identity: str = ''
    tracked: bool = False
    track: int = 0
    bodies: int = 0
    heard: int = 0
    mode: int = 0
    angles: dict[str, float] = field(default_factory=dict)
    described: tuple[Joint, ...] = ()

    def end(self) -> None:
        """Ends the body."""
        self.identity, self.tracked = '', False

    def continues_track(self, track: int) -> bool:
        """Whether the present body belongs to a track, given its number; 0: unnumbered."""
        return bool(self.identity) and track == self.track

    def begin(self, track: int) -> None:
        """Continues the body of a track, or begins a new body with a larger number."""
        if not self.continues_track(track):
            # A restarted filter numbers its tracks from 1 again.
            self.bodies = max(track, self.bodies + 1)
            self.identity = f'{self.name}_{self.bodies}'
            self.mode, self.angles, self.described = 0, {}, ()
        self.track, self.tracked = track, True


@dataclass(frozen=True)
class HriState(SessionState):
    """State of the bridge: its status is 'waiting', 'nobody' or 'tracking'.

    Attributes:
        bodies: identities of the tracked bodies.
    """

    bodies: tuple[str, ...] = ()

    def summary(self) -> str:
        """The present bodies in a few words."""
        return f'{len(self.bodies)} bodies'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [('bodies', ' '.join(self.bodies))]


class HriSession(Session[HriParameters, HriState]):
    """Turns mixtures into the messages of REP 155; see `Session` for arguments and attributes."""

    TOPICS = TOPICS
    COUNTED = MIXTURE
    UNIT = 'mixture'
    DONE = 'converted'
    ESTIMATE = 'every body'

    def _set_up(self) -> None:
        self._camera: Camera | None = None
        self._frame = ''
        self._now = 0
        self._clock = StampOrder()
        self._people: dict[str, _Person] = {}
        self.restart()

    @property
    def identities(self) -> set[str]:
        """Identities of the bodies with topics: tracked bodies, and lost bodies until they end."""
        return {person.identity for person in self._people.values() if person.identity}

    def needed_inputs(self) -> list[NeededInput]:
        """Inputs that are needed at present. Thread-safe."""
        return [NeededInput((mixture_source(name),)) for name in self.parameters.named]

    def _end(self) -> int:
        """Publishes that nobody is tracked any more."""
        tracked = bool(self._tracked())
        self.restart()
        self._orders.clear()
        if tracked:
            self._tell_tracked(self._now)
        return self._now

    def restart(self) -> None:
        """See `Session`."""
        # People are kept, so that the numbers of their bodies are not used again.
        for person in self._people.values():
            person.end()
        self._images: dict[int, Any] = {}
        super().restart()

    # Inputs.

    def _take(self, source: str, message: Any, stamp: int) -> None:
        if source == CAMERA_INFO:
            self._take_camera_info(message, stamp)
        elif source == IMAGE:
            self._images[stamp] = message
            while len(self._images) > _MAX_IMAGES:
                del self._images[next(iter(self._images))]
        else:
            self._take_mixture(source.removeprefix(mixture_source('')), message, stamp)

    def _take_camera_info(self, message: Any, stamp: int) -> None:
        # One stray stamp must not end all bodies.
        if self._clock.put(Stamped(stamp, None), expected=False).use:
            self._now = self._clock.newest = stamp
        try:
            self._camera, self._frame = camera_from_info(message), str(message.header.frame_id)
        except CameraInfoError as error:
            text = camera_info_fault(error, self._on_topic(CAMERA_INFO))
            self._log.fault('camera_info', text)
        longest = MAX_SILENCE * SECOND_NS
        silent = [p for p in self._people.values() if p.identity and self._now - p.heard > longest]
        for person in silent:
            person.end()
        if silent:
            self._tell_tracked(self._now)

    def _take_mixture(self, namespace: str, message: Any, stamp: int) -> None:
        try:
            content = pose_mixture_of(message)
        except MessageError as error:
            self._log.skip(error.fault, f'mixture of {stamp} ns: {error}')
            return
        person = self._person_in(namespace)
        if self._camera is None:
            self._now = stamp
        person.heard = self._now
        if content.state is TrackState.NOBODY or not len(content.weights):
            person.end()
        elif content.state is TrackState.LOST:
            person.tracked = False
        else:
            try:
                self._show(person, content)
            except ValueError as error:
                person.tracked = False
                self._log.skip('reference model', f'mixture of {stamp} ns shows no body: {error}')
                self._tell_tracked(stamp)
                return
        if not person.tracked:
            self._tell_tracked(stamp)
        self._log.counts['converted'] += 1

    def _person_in(self, namespace: str) -> _Person:
        if namespace not in self._people:
            gone = [name for name, person in self._people.items() if not person.identity]
            for name in gone[: max(len(gone) - _MAX_REMEMBERED_PEOPLE + 1, 0)]:
                del self._people[name]
            self._people[namespace] = _Person(_name_in(namespace))
        return self._people[namespace]

    # Outputs.

    def _tell_tracked(self, stamp: int) -> None:
        self._publish(TRACKED, stamp, ids_message(self._messages, self._tracked(), stamp))

    def _tracked(self) -> tuple[str, ...]:
        return tuple(sorted(p.identity for p in self._people.values() if p.tracked))

    def _show(self, person: _Person, content: PoseMixture) -> None:
        """Publishes the pose of a body.

        Raises:
            ValueError: the joint positions are impossible for a person.
        """
        p, stamp = self.parameters, content.stamp_ns
        shown = _shown_mode(content, person.mode if person.continues_track(content.track_id) else 0)
        before = person.angles if person.continues_track(content.track_id) else None
        human = fit_reference_human(
            content.joint_names, content.joint_positions[shown], before, additions=p.added_joints
        )
        person.begin(content.track_id)
        assert content.identities is not None
        person.mode, person.angles = int(content.identities[shown]), human.angles
        self._tell_tracked(stamp)
        self._publish_model(person, human, stamp, content.frame_id)
        if self._camera is None:
            return
        if self._frame and content.frame_id not in ('', self._frame):
            self._log.note(
                'other camera',
                f'mixtures of {person.name} are in the frame {content.frame_id}, camera_info is '
                f'that of {self._frame}: their image positions are not published; remap '
                'camera_info and image to the camera of the filter',
            )
            return
        self._publish_in_image(person, human, content, shown, self._camera)

    def _publish_model(
        self, person: _Person, human: ReferenceHuman, stamp: int, frame_id: str
    ) -> None:
        identity = person.identity
        if not _alike(human.joints, person.described):
            person.described = human.joints
            text = human_urdf(human, identity)
            message = self._messages.create('std_msgs/msg/String', data=text)
            self._publish(body_topic(identity, 'urdf'), stamp, message)
        if self._wanted(topic := body_topic(identity, 'joint_states')):
            message = human_joint_states(self._messages, human, identity, stamp)
            self._publish(topic, stamp, message)
        if self._wanted(FRAMES):
            links = self.parameters.publish_links
            message = human_transforms(
                self._messages, human, identity, stamp, frame_id, links=links
            )
            self._publish(FRAMES, stamp, message)

    def _publish_in_image(
        self,
        person: _Person,
        human: ReferenceHuman,
        content: PoseMixture,
        shown: int,
        camera: Camera,
    ) -> None:
        """Publishes the messages that need a calibration, unless the body is outside the image."""
        identity, stamp, frame = person.identity, content.stamp_ns, content.frame_id
        places, weights = content.joint_positions, content.weights
        region = region_in_image(camera, places[shown])
        if region is None:
            return
        if self._wanted(topic := body_topic(identity, 'roi')):
            others = [region_in_image(camera, each) for each in places]
            message = region_message(self._messages, camera, region, others, weights, stamp, frame)
            self._publish(topic, stamp, message)
        if self._wanted(topic := body_topic(identity, 'skeleton2d')):
            landmarks = landmarks_in_space(content.joint_names, places, human)
            message = skeleton_message(
                self._messages, camera, landmarks, shown, weights, stamp, frame
            )
            self._publish(topic, stamp, message)
        topic = body_topic(identity, 'cropped')
        if self.parameters.publish_cropped and self._wanted(topic):
            self._publish_cropped(topic, region, stamp)

    def _publish_cropped(self, topic: str, region: Array, stamp: int) -> None:
        image = self._images.get(stamp)
        if image is None:
            text = f'no image of {stamp} ns has come for a mixture: no cropped image is published'
            self._log.note('no image', text)
            return
        try:
            message = cropped_message(self._messages, image, region)
        except ImageError as error:
            self._log.note('image', str(error))
            return
        self._publish(topic, stamp, message)

    # State.

    def _present_state(self) -> HriState:
        bodies, wants = self._tracked(), ''
        if self._camera is None:
            wants = 'a calibrated camera_info'
        elif not self._people:
            wants = 'a pose mixture'
        status = 'waiting' if wants else 'tracking' if bodies else 'nobody'
        return HriState(status, wants, **self._totals(), bodies=bodies)


def _name_in(namespace: str) -> str:
    """Return the name of a person, from the namespace of the mixtures."""
    name = namespace.removeprefix(BODIES).strip('/').replace('/', '_')
    return name or 'body'


def _shown_mode(content: PoseMixture, before: int) -> int:
    """Return the index of the mode to show; `before` is the identity of the last mode, or 0."""
    assert content.identities is not None
    heaviest = int(np.argmax(content.weights))
    for k in np.flatnonzero(content.identities == before) if before else ():
        if content.weights[k] >= _MIN_RELATIVE_WEIGHT * content.weights[heaviest]:
            return int(k)
    return heaviest


def _alike(joints: tuple[Joint, ...], others: tuple[Joint, ...]) -> bool:
    """Whether two models have the same joints, up to small changes of their origins."""
    if [joint.name for joint in joints] != [joint.name for joint in others]:
        return False
    pairs = zip(joints, others, strict=True)
    return all(float(np.abs(a.origin - b.origin).max()) <= _MAX_ORIGIN_CHANGE for a, b in pairs)
