"""hmt_msgs/Keypoints2D: image positions of joints, as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools.messages.headers import header_message
from msg_tools.messages.message_error import MessageError, check_covariances, names_of, numbers
from msg_tools.messages.message_types import MessageFactory

Array = NDArray[np.float64]

# Of one person; detectors find up to a few hundred.
MAX_KEYPOINTS = 10_000


def keypoints_of(message: Any, sigma_px: float) -> Keypoints:
    """The content of an hmt_msgs/Keypoints2D, of `rosbags` or of ROS.

    Args:
        message: the message.
        sigma_px: standard deviation where the message has no covariance, px.

    Raises:
        MessageError: a name twice, arrays whose lengths contradict each other, a position of which
            one half is missing, a covariance that is not positive definite, a confidence beyond 0
            to 1.
    """
    if len(message.names) > MAX_KEYPOINTS:
        raise MessageError(
            f'keypoints has {len(message.names)} names, the limit is {MAX_KEYPOINTS}'
        )
    names = names_of(message.names, 'keypoints')
    n = len(names)
    if n == 0:
        raise MessageError('keypoints has no names')
    pixels = np.stack(
        [numbers(message.u, (n,), 'keypoints: u'), numbers(message.v, (n,), 'keypoints: v')], 1
    )
    covariances = np.tile(sigma_px**2 * np.eye(2), (n, 1, 1))
    if len(message.covariance):
        covariances = numbers(message.covariance, (n, 2, 2), 'keypoints: covariance').copy()
    confidences = np.ones(n)
    if len(message.confidence):
        confidences = numbers(message.confidence, (n,), 'keypoints: confidence')
    missing = np.isnan(pixels)
    halved = (missing[:, 0] != missing[:, 1]) | np.isinf(pixels).any(1)
    outside = ~((confidences >= 0) & (confidences <= 1))
    covariances[missing[:, 0]] = np.eye(2)
    for i, name in enumerate(names):
        if halved[i]:
            raise MessageError(
                f'keypoint {name} lies at {tuple(pixels[i].tolist())}, wanted numbers, or NaN '
                'twice for not seen'
            )
        check_covariances(covariances[i], f'keypoint {name}')
        if outside[i]:
            raise MessageError(f'keypoint {name} has confidence {confidences[i]}, wanted 0 to 1')
    return Keypoints(names, pixels, covariances, confidences)


def keypoints_message(
    messages: MessageFactory, keypoints: Keypoints, stamp_ns: int, frame_id: str
) -> Any:
    """hmt_msgs/Keypoints2D of an image with a stamp, in the optical frame of its camera."""
    return messages.create(
        'hmt_msgs/msg/Keypoints2D',
        header=header_message(messages, stamp_ns, frame_id),
        names=list(keypoints.names),
        u=keypoints.pixels[:, 0],
        v=keypoints.pixels[:, 1],
        covariance=keypoints.covariances.reshape(-1),
        confidence=keypoints.confidences,
    )
