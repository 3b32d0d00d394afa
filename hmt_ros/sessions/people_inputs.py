"""Reads people from the messages of a detector, as body joints and positions in the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from hmt_ros.body import Body
from hmt_ros.image.association import Sighting
from hmt_ros.image.keypoint_evidence import MIN_KEYPOINTS
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.handled import HandlingLog
from hmt_ros.sessions.keypoint_inputs import DetectionReader
from hmt_ros.sessions.tracking_parameters import PeopleParameters
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    DetectedPerson,
)


@dataclass(frozen=True, eq=False)
class Found:
    """A person in the detections of an image.

    Attributes:
        detected: person as read from the message.
        keypoints: seen keypoints, named as joints of the body.
        sighting: position of the person in the image.
    """

    detected: DetectedPerson
    keypoints: Keypoints
    sighting: Sighting

    @property
    def suffices(self) -> bool:
        """Whether the detection is enough to start a track."""
        return self.detected.box is not None or len(self.keypoints.names) >= MIN_KEYPOINTS


class PeopleReader(DetectionReader):
    """Reads the detections of several people.

    Args:
        parameters: parameters of the node; only `source` and `keypoint_scheme` are used.
    """

    def __init__(self, parameters: PeopleParameters, log: HandlingLog) -> None:
        super().__init__(parameters.source, log)
        self._order = parameters.order

    def people(self, message: Any, stamp: int) -> list[DetectedPerson]:
        """Return the people in a message.

        Raises:
            MessageError: the message can not be used.
        """
        people = self._people(message, stamp, self._order)
        names: set[str] = set()
        for i, person in enumerate(people):
            if person.name and person.name in names:
                self._log.fault(
                    'detections',
                    f'detections of {stamp} ns have the id {person.name!r} twice, wanted each id '
                    'once: the second is treated as having none',
                )
                people[i] = person._replace(name='')
            names.add(person.name)
        return people

    def found(
        self, people: Sequence[DetectedPerson], body: Body, scheme: str, *, use_keypoints: bool
    ) -> list[Found]:
        """Return the people who are at least partly visible.

        Args:
            use_keypoints: whether to return keypoints; otherwise keypoints only give the extent of
                a person.
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
                if unknown:
                    self._report(sorted(unknown), scheme)
            result.append(Found(person, keypoints, Sighting.of(keypoints, corners)))
        return result
