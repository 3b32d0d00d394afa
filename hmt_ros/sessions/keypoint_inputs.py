"""Keypoints of the person who is tracked, from messages of any detector, and what they wait with.

The parameter `source` says what the messages are: hmt_msgs/Keypoints2D of one person, or those of
other detectors, of one person or of several:

- Skeleton2D is in units of the image: it needs a camera_info before. Its topic belongs to one
  person already. Float32MultiArray without a stamp has that of the newest camera_info.
- Of several people one is chosen: by `person_id`, or the largest at first, and then the one who is
  nearest to the last place.

Keypoints without names say that nobody was seen. Positions in space join the keypoints of their
stamp by name.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from hmt_ros.body import Body, Camera
from hmt_ros.experts.lifter import Lifter, load_lifter
from hmt_ros.image.keypoint_schemes import AUTO, JOINTS
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.chosen_person import ChosenPerson
from hmt_ros.sessions.declared_parameters import OWN_KEYPOINTS, CameraNodeParameters
from hmt_ros.sessions.handled import Fault, HandlingLog
from hmt_ros.sessions.image_inputs import DETECTIONS, KEYPOINTS_INPUT, SOURCES, ImageInput
from msg_tools import MessageError
from msg_tools.files.error_line import error_line
from msg_tools.messages.detections import (
    NO_KEYPOINTS,
    people_of_floats,
    people_of_yolo,
    person_of_skeleton,
)
from msg_tools.messages.keypoints import Positions, keypoints_of

# Time without the person after which the largest one is chosen anew, s.
LONGEST_ABSENCE = 1.0
# Sets of unknown names that are warned of, each once; a detector has one.
_MOST_WARNINGS = 20


def known_lifter(model: str) -> Lifter | None:
    """The experts that a parameter `lifter` names; None: it is empty.

    Raises:
        ValueError: there is no such file, or it is no lifter; one line.
    """
    try:
        return load_lifter(model) if model else None
    except OSError as error:
        raise ValueError(f'lifter {model}: {error_line(error)}') from error


def keypoints_input(source: str) -> ImageInput:
    """The input of keypoints with messages of a `source`."""
    if source == OWN_KEYPOINTS:
        return KEYPOINTS_INPUT
    return replace(KEYPOINTS_INPUT, types={DETECTIONS: SOURCES[source]})


class KeypointReader:
    """Reads the keypoints of the person who is tracked.

    Args:
        source: as the parameter.
        log: takes remarks.
    """

    def __init__(self, source: str, log: HandlingLog) -> None:
        self._source, self._log = source, log
        self._chosen = ChosenPerson()
        self._unknown: set[frozenset[str]] = set()

    def read(
        self, message: Any, stamp: int, parameters: CameraNodeParameters, body: Body,
        camera: Camera | None, sigma_px: float = 0.0,
    ) -> Keypoints:  # fmt: skip
        """The keypoints in a message.

        Args:
            message: of the source.
            stamp: of the message, ns.
            parameters: how.
            body: whose joints they may name.
            camera: that took the image; None: it is not known yet.
            sigma_px: standard deviation of keypoints without one, px; 0: as is learned.

        Raises:
            ValueError: it can not be used; one line.
        """
        found = self._found(message, stamp, parameters, camera, sigma_px)
        if found is None or not found.names:
            return NO_KEYPOINTS
        _, unknown = found.named_for(body, parameters.keypoint_scheme)
        if unknown:
            self._report(unknown, parameters.keypoint_scheme)
        return found

    def _found(
        self, message: Any, stamp: int, p: CameraNodeParameters, camera: Camera | None,
        sigma_px: float,
    ) -> Keypoints | None:  # fmt: skip
        if self._source == OWN_KEYPOINTS:
            return keypoints_of(message, sigma_px) if len(message.names) else None
        try:
            if self._source == 'skeleton2d':
                if camera is None:
                    raise MessageError(
                        'it comes before a calibrated camera_info, which tells the size of the '
                        'image'
                    )
                person = person_of_skeleton(message, camera.width, camera.height).keypoints
                return person[np.flatnonzero(person.seen)]
            if stamp == 0:
                raise MessageError('it comes before a camera_info, which tells its stamp')
            read = people_of_yolo if self._source == 'yolo' else people_of_floats
            people = read(message, p.order)
        except MessageError as error:
            raise MessageError(f'detection of {stamp} ns: {error}') from error
        if p.person_id:
            own = (x.keypoints for x in people if x.name == p.person_id and x.keypoints.seen.any())
            chosen = next(own, None)
        else:
            chosen = self._chosen.choose(people, stamp, LONGEST_ABSENCE)
        return None if chosen is None else chosen[np.flatnonzero(chosen.seen)]

    def at_joints(
        self, found: Keypoints | None, positions: Positions | None, body: Body, scheme: str,
        stamp_ns: int,
    ) -> Keypoints | None:  # fmt: skip
        """The keypoints that were seen in an image, maybe none, as joints of the body.

        Args:
            found: as read; None: none have come.
            positions: of the same landmarks in space; None: none have come.
            body: whose joints they become.
            scheme: what their names mean.
            stamp_ns: of the image.
        """
        if found is None or not found.names:
            return found
        if positions is not None:
            found = positions.added_to(found)
            if not set(positions.names) & set(found.names):
                self._log.note(
                    Fault.KEYPOINTS_3D,
                    f'keypoints_3d of {stamp_ns} ns has none of the names of its keypoints, such '
                    f'as {found.names[0]!r}, but {positions.names[0]!r}',
                )
        known, _ = found.named_for(body, scheme)
        return known[np.flatnonzero(known.seen)] if known.names else None

    def forget(self) -> None:
        """Whom the messages were about is chosen anew."""
        self._chosen.forget()

    def _report(self, unknown: list[str], scheme: str) -> None:
        names = frozenset(unknown)
        new = names not in self._unknown and len(self._unknown) < _MOST_WARNINGS
        if new:
            self._unknown.add(names)
        known = {AUTO: 'of the body or of a known scheme', JOINTS: 'of the body'}
        self._log.note(
            Fault.KEYPOINT_NAMES,
            f'keypoints {unknown} are not used: wanted names of joints '
            f'{known.get(scheme, f"in the scheme {scheme}")}',
            warn=new,
        )
