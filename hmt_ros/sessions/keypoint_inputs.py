"""Keypoints that wait for their image: in the plane, and of the same landmarks in space.

Of several keypoints of one stamp the last count; keypoints without names say that nobody was seen.
Positions in space join the keypoints of their stamp by name.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hmt_ros.body import Body
from hmt_ros.experts.lifter import Lifter, load_lifter
from hmt_ros.image.keypoint_schemes import AUTO, JOINTS
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.sessions.camera_session import StampedInputs
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.handled import Fault, HandlingLog
from msg_tools import MessageError
from msg_tools.files.error_line import error_line
from msg_tools.messages.detections import NO_KEYPOINTS
from msg_tools.messages.keypoints import Positions, keypoints_of, positions_of

KEYPOINTS, KEYPOINTS_3D = 'keypoints', 'keypoints_3d'

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


class KeypointInputs:
    """The keypoints that have come.

    Args:
        log: takes faults.

    Attributes:
        plane: keypoints by stamp.
        space: positions of the same landmarks by stamp.
    """

    def __init__(self, log: HandlingLog) -> None:
        self._log = log
        self.plane: StampedInputs[Keypoints] = StampedInputs()
        self.space: StampedInputs[Positions] = StampedInputs()
        self._unknown: set[frozenset[str]] = set()

    def clear(self) -> None:
        """Drops all that have come."""
        self.plane.clear()
        self.space.clear()

    def put(self, message: Any, stamp_ns: int, parameters: FilterParameters, body: Body) -> None:
        """Takes an hmt_msgs/Keypoints2D; one that can not be used counts as none."""
        p = parameters
        self.plane.put(stamp_ns, self.read(message, body, p.keypoint_scheme, p.keypoint_sigma_px))

    def put_3d(self, message: Any, stamp_ns: int) -> None:
        """Takes an hmt_msgs/Keypoints3D; one that can not be used counts as none."""
        content = None
        if len(message.names):
            try:
                content = positions_of(message)
            except MessageError as error:
                self._log.fault(Fault.KEYPOINTS_3D, str(error))
        self.space.put(stamp_ns, content)

    def take(self, stamp_ns: int, parameters: FilterParameters, body: Body) -> Keypoints | None:
        """The keypoints that were seen in an image, maybe none, as joints of the body.

        Returns:
            They have positions if some have come; None: no keypoints have come.
        """
        found = self.plane.take(stamp_ns)
        positions = self.space.take(stamp_ns) if parameters.use_keypoints_3d else None
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
        known, _ = found.named_for(body, parameters.keypoint_scheme)
        return known[np.flatnonzero(known.seen)] if known.names else None

    def read(
        self, message: Any, body: Body, scheme: str, sigma_px: float = 0.0
    ) -> Keypoints | None:
        """The keypoints in an hmt_msgs/Keypoints2D; None: it can not be used, which is reported."""
        if len(message.names) == 0:
            return NO_KEYPOINTS
        try:
            content = keypoints_of(message, sigma_px)
        except MessageError as error:
            self._log.fault(Fault.KEYPOINTS, str(error))
            return None
        _, unknown = content.named_for(body, scheme)
        if unknown:
            self._report(unknown, scheme)
        return content

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
