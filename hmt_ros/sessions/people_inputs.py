"""The people in the messages of a detector, as joints of the body and places in the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmt_ros.body import Body
from hmt_ros.image.association import Sighting
from hmt_ros.image.keypoint_evidence import FEWEST_KEYPOINTS
from hmt_ros.image.keypoint_schemes import Scheme
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.handled import HandlingLog
from hmt_ros.sessions.tracking_parameters import PeopleParameters
from msg_tools import MessageError
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    DetectedPerson,
    people_of_boxes,
    people_of_floats,
    people_of_message,
    people_of_yolo,
)

# The people in a message, by the parameter `source`, where keypoints without names have an order.
_READERS: dict[str, Callable[[Any, Scheme], list[DetectedPerson]]] = {
    'people': lambda message, _: people_of_message(message),
    'boxes': lambda message, _: people_of_boxes(message),
    'yolo': people_of_yolo,
    'floats': people_of_floats,
}


@dataclass(frozen=True, eq=False)
class Found:
    """A person in the detections of an image.

    Attributes:
        detected: as the detector says.
        keypoints: at joints of the body, those that were seen.
        sighting: where the person is in the image.
    """

    detected: DetectedPerson
    keypoints: Keypoints
    sighting: Sighting

    @property
    def suffices(self) -> bool:
        """Whether this is enough to follow somebody."""
        return self.detected.box is not None or len(self.keypoints.names) >= FEWEST_KEYPOINTS


class PeopleReader:
    """Reads the detections.

    Args:
        parameters: `source` and `keypoint_scheme` say how.
    """

    def __init__(self, parameters: PeopleParameters, log: HandlingLog) -> None:
        self._source, self._scheme = parameters.source, parameters.order
        self._log = log
        self._unknown: set[frozenset[str]] = set()

    def people(self, message: Any, stamp: int) -> list[DetectedPerson]:
        """The people in a message.

        Raises:
            MessageError: it can not be used.
        """
        try:
            people = _READERS[self._source](message, self._scheme)
        except MessageError as error:
            raise MessageError(f'detections of {stamp} ns: {error}') from error
        names: set[str] = set()
        for i, person in enumerate(people):
            if person.name and person.name in names:
                self._log.fault(
                    'detections',
                    f'detections of {stamp} ns have the id {person.name!r} twice, wanted each id '
                    'once: the second is taken to have none',
                )
                people[i] = person._replace(name='')
            names.add(person.name)
        return people

    def found(
        self, people: Sequence[DetectedPerson], body: Body, scheme: str, *, use_keypoints: bool
    ) -> list[Found]:
        """The people who are at least partly visible.

        Args:
            use_keypoints: whether they are used for more than boxes.
        """
        result = []
        for person in people:
            corners = person.extent
            if corners is None:
                continue
            keypoints = NO_KEYPOINTS
            if use_keypoints and person.keypoints.names:
                known, unknown = person.keypoints.named_for(body, scheme)
                keypoints = known[np.flatnonzero(known.seen)]
                self._report(frozenset(unknown))
            result.append(Found(person, keypoints, Sighting.of(keypoints, corners)))
        return result

    def _report(self, unknown: frozenset[str]) -> None:
        if not unknown or unknown in self._unknown:
            return
        self._unknown.add(unknown)
        self._log.note(
            'names of keypoints',
            f'keypoints {sorted(unknown)} are not used: wanted names of joints of the body or of '
            'a known scheme',
        )
