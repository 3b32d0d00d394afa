"""hmt_msgs/Keypoints2D and hmt_msgs/Keypoints3D: keypoints of a person, as arrays.

A keypoint is not seen if its confidence is 0, if its position is not a number, or if it lies at
(0, 0) in the image, where detectors put missing keypoints. Its other fields then do not matter.
A message without names says that nobody was seen; it has no keypoints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import (
    Array,
    MessageError,
    check_covariances,
    names_of,
    numbers,
)
from msg_tools.messages.message_types import MessageFactory

KEYPOINTS_2D, KEYPOINTS_3D = 'hmt_msgs/msg/Keypoints2D', 'hmt_msgs/msg/Keypoints3D'
# Of one person; detectors find up to a few hundred.
MAX_KEYPOINTS = 10_000
# Numbers beyond these are no places of a person: px from the first pixel, m from the origin.
FARTHEST_PIXEL, FARTHEST_POSITION = 1e6, 1e3


@dataclass(frozen=True)
class Positions:
    """Landmarks of a person in space, relative to each other, from a detector that lifts.

    Attributes:
        names: (n,) of the landmarks.
        positions: (n, 3) m, along the axes of the camera from an origin that all share; NaN where
            there is none.
    """

    names: tuple[str, ...]
    positions: Array

    def added_to(self, keypoints: Keypoints) -> Keypoints:
        """The keypoints with the positions of the same names; NaN for those without."""
        places = {name: i for i, name in enumerate(self.names)}
        positions = np.full((len(keypoints.names), 3), np.nan)
        for i, name in enumerate(keypoints.names):
            if name in places:
                positions[i] = self.positions[places[name]]
        return replace(keypoints, positions=positions)


def keypoints_of(message: Any, sigma_px: float = 0.0) -> Keypoints:
    """The content of an hmt_msgs/Keypoints2D, of `rosbags` or of ROS.

    Args:
        sigma_px: standard deviation where the message has no covariance, px; 0: unknown.

    Returns:
        The keypoints; those that were not seen have NaN as pixels, and confidence 0. Unknown
        covariances are NaN. None at all where nobody was seen.

    Raises:
        MessageError: a name twice, arrays whose lengths contradict each other, a position of which
            one half is missing, or that is beyond all images, a covariance that is not positive
            definite, a confidence beyond 0 to 1.
    """
    names, pixels, confidences = _points_of(message, 'uv', 'keypoints')
    n = len(names)
    covariances = None
    if len(message.covariance):
        covariances = numbers(message.covariance, (n, 2, 2), 'keypoints: covariance').copy()
    found = checked_keypoints(names, pixels, confidences, covariances)
    if not sigma_px:
        return found
    unknown = np.isnan(found.covariances)
    return replace(found, covariances=np.where(unknown, sigma_px**2 * np.eye(2), found.covariances))


def checked_keypoints(
    names: tuple[str, ...], pixels: Array, confidences: Array, covariances: Array | None = None
) -> Keypoints:
    """Keypoints as a detector reports them; those that were not seen lose their other values.

    Args:
        names: (n,), each once.
        pixels: (n, 2) px; changed in place, like the others.
        confidences: (n,).
        covariances: (n, 2, 2) px^2; NaN: unknown of a keypoint, None: of all.

    Raises:
        MessageError: as `keypoints_of`.
    """
    seen = (confidences != 0) & ~np.isnan(pixels).all(1) & (pixels != 0).any(1)
    for i in np.flatnonzero(seen):
        _check_point(names[i], pixels[i], confidences[i], FARTHEST_PIXEL, 'px')
        if covariances is not None and not np.isnan(covariances[i]).all():
            check_covariances(covariances[i], f'keypoint {names[i]}')
    pixels[~seen], confidences[~seen] = np.nan, 0.0
    if covariances is None:
        covariances = np.full((len(names), 2, 2), np.nan)
    else:
        covariances[~seen] = np.eye(2)
    return Keypoints(names, pixels, covariances, confidences)


def positions_of(message: Any) -> Positions:
    """The content of an hmt_msgs/Keypoints3D, of `rosbags` or of ROS.

    A landmark has a position unless its confidence is 0; higher confidences all count the same
    here. There are no landmarks where nobody was seen.

    Raises:
        MessageError: as `keypoints_of`.
    """
    names, positions, confidences = _points_of(message, 'xyz', 'keypoints_3d')
    seen = (confidences != 0) & ~np.isnan(positions).all(1)
    for i in np.flatnonzero(seen):
        _check_point(names[i], positions[i], confidences[i], FARTHEST_POSITION, 'm')
    positions[~seen] = np.nan
    return Positions(names, positions)


def keypoints_message(
    messages: MessageFactory, keypoints: Keypoints, stamp_ns: int, frame_id: str
) -> Any:
    """hmt_msgs/Keypoints2D of an image with a stamp, in the optical frame of its camera.

    Args:
        keypoints: maybe none: nobody was seen. Unknown covariances are NaN; a message has none if
            all are unknown.
        frame_id: optical frame of the camera.
    """
    known = bool(np.isfinite(keypoints.covariances).any())
    return messages.create(
        KEYPOINTS_2D,
        header=header_message(messages, stamp_ns, frame_id),
        names=list(keypoints.names),
        u=keypoints.pixels[:, 0],
        v=keypoints.pixels[:, 1],
        covariance=keypoints.covariances.reshape(-1) if known else np.empty(0),
        confidence=keypoints.confidences,
    )


def positions_message(
    messages: MessageFactory, keypoints: Keypoints, stamp_ns: int, frame_id: str
) -> Any:
    """hmt_msgs/Keypoints3D of keypoints that have positions, else of none."""
    names, positions = list(keypoints.names), keypoints.positions
    confidences = keypoints.confidences
    if positions is None:
        names, positions, confidences = [], np.empty((0, 3)), np.empty(0)
    return messages.create(
        KEYPOINTS_3D,
        header=header_message(messages, stamp_ns, frame_id),
        names=names,
        x=positions[:, 0],
        y=positions[:, 1],
        z=positions[:, 2],
        confidence=confidences,
    )


def _points_of(message: Any, symbols: str, what: str) -> tuple[tuple[str, ...], Array, Array]:
    """Names (n,), places (n, d) in the fields of so many symbols, and confidences (n,)."""
    n = len(message.names)
    if n > MAX_KEYPOINTS:
        raise MessageError(f'{what} has {n} names, the limit is {MAX_KEYPOINTS}')
    names = names_of(message.names, what)
    columns = [numbers(getattr(message, x), (n,), f'{what}: {x}') for x in symbols]
    confidences = np.ones(n)
    if len(message.confidence):
        confidences = numbers(message.confidence, (n,), f'{what}: confidence')
    return names, np.stack(columns, axis=1), confidences


def _check_point(name: str, place: Array, confidence: float, farthest: float, unit: str) -> None:
    if not np.abs(place).max() <= farthest:  # or NaN
        raise MessageError(
            f'keypoint {name} lies at {tuple(place.tolist())}, wanted numbers within {farthest:g} '
            f'{unit}, or NaN for all of them where it was not seen'
        )
    if not 0 <= confidence <= 1:
        raise MessageError(f'keypoint {name} has confidence {confidence}, wanted 0 to 1')
