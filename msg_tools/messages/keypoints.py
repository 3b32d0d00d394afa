"""hmt_msgs/Keypoints2D and hmt_msgs/Keypoints3D: keypoints of a person, as arrays.

A keypoint is unseen if its confidence is 0, if its position is NaN, or if it is at (0, 0) in the
image, where detectors put missing keypoints. Its other fields are then ignored. A message without
names has no keypoints and means that nobody was seen.
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
# Maximum number of keypoints of one person; detectors find up to a few hundred.
MAX_KEYPOINTS = 10_000
# Maximum coordinates of keypoints: in the image, px from the first pixel; in 3D, m from the origin.
MAX_PIXEL, MAX_POSITION = 1e6, 1e3


@dataclass(frozen=True)
class Positions:
    """Relative 3D positions of landmarks of a person, from a detector of 3D keypoints.

    Attributes:
        names: (n,) names of the landmarks.
        positions: (n, 3) positions along the camera axes from a common origin, m; NaN if unknown.
    """

    names: tuple[str, ...]
    positions: Array

    def added_to(self, keypoints: Keypoints) -> Keypoints:
        """Adds positions to keypoints by name; keypoints without a position get NaN."""
        places = {name: i for i, name in enumerate(self.names)}
        positions = np.full((len(keypoints.names), 3), np.nan)
        for i, name in enumerate(keypoints.names):
            if name in places:
                positions[i] = self.positions[places[name]]
        return replace(keypoints, positions=positions)


def keypoints_of(message: Any, sigma_px: float = 0.0) -> Keypoints:
    """Reads an hmt_msgs/Keypoints2D message of `rosbags` or of ROS.

    Args:
        sigma_px: standard deviation of keypoints without covariance, px; 0 if unknown.

    Returns:
        The keypoints, empty if nobody was seen. Unseen keypoints have pixels NaN and confidence 0.
        Unknown covariances are NaN.

    Raises:
        MessageError: a name that occurs twice, inconsistent lengths of arrays, a position far
            outside of any image or with only one coordinate, a covariance that is not positive
            definite, or a confidence outside of [0, 1].
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
    """Checks the keypoints of a detector, and clears the values of unseen keypoints.

    Args:
        names: (n,) distinct names.
        pixels: (n, 2) image positions, px; all arrays are changed in place.
        confidences: (n,) confidences, 0 to 1.
        covariances: (n, 2, 2) covariances of the pixels, px^2; NaN for a keypoint if unknown, None
            if all are unknown.

    Raises:
        MessageError: see `keypoints_of`.
    """
    seen = (confidences != 0) & ~np.isnan(pixels).all(1) & (pixels != 0).any(1)
    for i in np.flatnonzero(seen):
        _check_point(names[i], pixels[i], confidences[i], MAX_PIXEL, 'px')
        if covariances is not None and not np.isnan(covariances[i]).all():
            check_covariances(covariances[i], f'keypoint {names[i]}')
    pixels[~seen], confidences[~seen] = np.nan, 0.0
    if covariances is None:
        covariances = np.full((len(names), 2, 2), np.nan)
    else:
        covariances[~seen] = np.eye(2)
    return Keypoints(names, pixels, covariances, confidences)


def positions_of(message: Any) -> Positions:
    """Reads an hmt_msgs/Keypoints3D message of `rosbags` or of ROS.

    A landmark has a position unless its confidence is 0; the confidence has no other effect. The
    result is empty if nobody was seen.

    Raises:
        MessageError: see `keypoints_of`.
    """
    names, positions, confidences = _points_of(message, 'xyz', 'keypoints_3d')
    seen = (confidences != 0) & ~np.isnan(positions).all(1)
    for i in np.flatnonzero(seen):
        _check_point(names[i], positions[i], confidences[i], MAX_POSITION, 'm')
    positions[~seen] = np.nan
    return Positions(names, positions)


def keypoints_message(
    messages: MessageFactory, keypoints: Keypoints, stamp_ns: int, frame_id: str
) -> Any:
    """Makes an hmt_msgs/Keypoints2D of the keypoints in an image.

    Args:
        keypoints: keypoints, empty if nobody was seen. Unknown covariances are NaN; the message has
            no covariances if all are unknown.
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
    """Makes an hmt_msgs/Keypoints3D of keypoints; without 3D positions the message is empty."""
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
    """Names (n,), coordinates (n, d) from d fields, and confidences (n,) of a message."""
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
    if not np.abs(place).max() <= farthest:  # also true for NaN
        raise MessageError(
            f'keypoint {name} lies at {tuple(place.tolist())}, wanted numbers within {farthest:g} '
            f'{unit}, or NaN for all of them where it was not seen'
        )
    if not 0 <= confidence <= 1:
        raise MessageError(f'keypoint {name} has confidence {confidence}, wanted 0 to 1')
