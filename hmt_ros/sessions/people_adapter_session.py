"""People for other packages: mixtures of one person or several in, points and boxes out.

- Every mixture gets one people_msgs/People and one vision_msgs/Detection3DArray with its stamp and
  frame, which hold all people of that frame whose last mixture is not older than `longest_silence`.
- A person whose track is lost, and a mixture without components, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from hmt_ros.body import named_body
from hmt_ros.sessions.people_adapter_parameters import PeopleAdapterParameters
from hmt_ros.sessions.session import Order, PublishedTopic, Session, SessionState
from msg_tools import MessageError
from msg_tools.files.error_line import error_line
from msg_tools.messages.bodies import body_of
from msg_tools.messages.headers import SECOND_NS
from msg_tools.messages.message_error import MessageFault
from msg_tools.messages.people import (
    DETECTIONS_3D,
    PEOPLE,
    PERSON,
    SeenPerson,
    detections_message,
    people_message,
)
from msg_tools.messages.pose_mixtures import PoseMixture, TrackState, pose_mixture_of

# Sources are topics of mixtures, this one below a namespace.
MIXTURE = 'pose_mixture'
TOPICS = {'people': PublishedTopic(PEOPLE), 'detections': PublishedTopic(DETECTIONS_3D)}
MAKERS = {'people': people_message, 'detections': detections_message}


class _Last(NamedTuple):
    """The last mixture of a person; None: the person was not seen in it."""

    stamp_ns: int
    frame_id: str
    person: SeenPerson | None


@dataclass(frozen=True)
class PeopleAdapterState(SessionState):
    """State of the adapter: its status is 'waiting', 'nobody' or 'seeing'.

    Attributes:
        people: number of people in the last message.
    """

    people: int = 0

    def summary(self) -> str:
        """The present people in a few words."""
        return f'{self.people} people'

    def values(self) -> list[tuple[str, str]]:
        """Keys and values of the diagnostics."""
        return [('people', str(self.people))]


class PeopleAdapterSession(Session[PeopleAdapterParameters, PeopleAdapterState]):
    """Gathers people; see `Session` for arguments and attributes."""

    TOPICS = TOPICS
    COUNTED = MIXTURE
    UNIT = 'mixture'
    DONE = 'converted'
    ESTIMATE = 'the list of people'
    CHECKED = ()

    def _set_up(self) -> None:
        self._last: dict[str, _Last] = {}
        self._people = 0
        self.state = self._present_state()

    def _forget(self) -> None:
        self._last.clear()
        self._people = 0

    def _take(self, source: str, message: Any, stamp: int) -> None:
        if source != self.COUNTED:
            self._log.counts['received'] += 1
        known = self._last.get(source)
        order = self._order(stamp, None if known is None else known.stamp_ns)
        if order is Order.SKIPPED:
            return
        if order is Order.JUMP:
            self.restart()
        try:
            content = pose_mixture_of(message)
            person = self._person_in(content, source)
        except MessageError as error:
            self._log.skip(error.fault, f'mixture of {stamp} ns: {error}')
            return
        self._last[source] = _Last(stamp, content.frame_id, person)
        people = self._present(stamp, content.frame_id)
        self._people = len(people)
        self._log.counts['converted'] += 1
        for topic in self.TOPICS:
            if self._wanted(topic):
                made = MAKERS[topic](self._messages, people, stamp, content.frame_id)
                self._publish(topic, stamp, made)

    def _person_in(self, content: PoseMixture, source: str) -> SeenPerson | None:
        """The person of a mixture; None: nobody, or lost.

        Raises:
            MessageError: a body that is not known, or a mixture without covariances.
        """
        if not len(content.weights) or content.state in (TrackState.LOST, TrackState.NOBODY):
            return None
        try:
            body = body_of(content, named_body(content.body_model))
        except OSError as error:
            raise MessageError(error_line(error), MessageFault.BODY) from error
        namespace = source.rpartition('/')[0]
        name = namespace.rpartition('/')[2] or PERSON
        if content.track_id:
            name = f'{name}_{content.track_id}'
        return SeenPerson.of(name, content, body)

    def _present(self, stamp: int, frame_id: str) -> list[SeenPerson]:
        """People who have been seen lately in a frame."""
        oldest = stamp - self.parameters.longest_silence * SECOND_NS
        return [
            one.person
            for _, one in sorted(self._last.items())
            if one.person is not None and one.frame_id == frame_id and one.stamp_ns >= oldest
        ]

    def _present_state(self) -> PeopleAdapterState:
        status, wants = 'waiting', 'a pose mixture'
        if self._last:
            status, wants = ('seeing', '') if self._people else ('nobody', '')
        return PeopleAdapterState(status, wants, **self._totals(), people=self._people)
