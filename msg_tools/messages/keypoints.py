"""hmt_msgs/Keypoints2D: image positions of joints, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_tools.messages.headers import header_message, time_ns
from msg_tools.messages.message_error import MessageError, check_covariances, names_of, numbers
from msg_tools.messages.message_types import MessageFactory

Array = NDArray[np.float64]

# Of one person; detectors find up to a few hundred.
MAX_KEYPOINTS = 10_000


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Joints of one person in one image.

    Attributes:
        names: (n,) of the joints.
        pixels: (n, 2) column and row, px; both NaN where the joint was not seen.
        covariances: (n, 2, 2) px^2; identity where the joint was not seen.
        confidence: (n,) from 0, ignore, to 1, sure.
        stamp_ns: of the image.
        frame_id: optical frame of the camera.

    Raises:
        MessageError: shapes or values that a message must not have.
    """

    names: tuple[str, ...]
    pixels: Array
    covariances: Array
    confidence: Array
    stamp_ns: int
    frame_id: str

    def __post_init__(self) -> None:
        object.__setattr__(self, 'names', names_of(self.names, 'keypoints'))
        n = len(self.names)
        shapes = {'pixels': (n, 2), 'covariances': (n, 2, 2), 'confidence': (n,)}
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != shape:
                raise MessageError(f'keypoints: {name} has shape {array.shape}, wanted {shape}')
            object.__setattr__(self, name, array)
        missing = np.isnan(self.pixels)
        if (missing[:, 0] != missing[:, 1]).any() or np.isinf(self.pixels).any():
            index = int(np.argmax((missing[:, 0] != missing[:, 1]) | np.isinf(self.pixels).any(1)))
            raise MessageError(
                f'keypoint {self.names[index]} lies at {tuple(self.pixels[index].tolist())}, '
                'wanted numbers, or NaN twice for not seen'
            )
        self.covariances[missing[:, 0]] = np.eye(2)
        for name, covariance in zip(self.names, self.covariances, strict=True):
            check_covariances(covariance, f'keypoint {name}')
        outside = ~((self.confidence >= 0) & (self.confidence <= 1))
        if outside.any():
            index = int(np.argmax(outside))
            raise MessageError(
                f'keypoint {self.names[index]} has confidence {self.confidence[index]}, '
                'wanted 0 to 1'
            )
        for name in shapes:
            getattr(self, name).setflags(write=False)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(n,) joints that have a position."""
        result: NDArray[np.bool_] = ~np.isnan(self.pixels[:, 0])
        return result


def keypoints_of(
    message: Any, sigma_px: float, joint_names: Sequence[str] | None = None
) -> Keypoints:
    """The content of an hmt_msgs/Keypoints2D, of `rosbags` or of ROS.

    Args:
        message: the message.
        sigma_px: standard deviation where the message has no covariance, px.
        joint_names: names that are known; None: any.

    Raises:
        MessageError: an unknown joint, arrays whose lengths contradict each other, a position of
            which one half is missing, a covariance that is not positive definite, a confidence
            beyond 0 to 1.
    """
    if len(message.names) > MAX_KEYPOINTS:
        raise MessageError(
            f'keypoints has {len(message.names)} names, the limit is {MAX_KEYPOINTS}'
        )
    names = names_of(message.names, 'keypoints')
    n = len(names)
    if n == 0:
        raise MessageError('keypoints has no names')
    if joint_names is not None:
        for name in names:
            if name not in joint_names:
                raise MessageError(f'keypoint {name!r} is not a joint of the body')
    pixels = np.stack(
        [numbers(message.u, (n,), 'keypoints: u'), numbers(message.v, (n,), 'keypoints: v')], 1
    )
    if len(message.covariance):
        covariances = numbers(message.covariance, (n, 2, 2), 'keypoints: covariance')
    else:
        covariances = np.tile(sigma_px**2 * np.eye(2), (n, 1, 1))
    if len(message.confidence):
        confidence = numbers(message.confidence, (n,), 'keypoints: confidence')
    else:
        confidence = np.ones(n)
    return Keypoints(
        names,
        pixels,
        covariances,
        confidence,
        time_ns(message.header.stamp),
        str(message.header.frame_id),
    )


def keypoints_message(messages: MessageFactory, content: Keypoints) -> Any:
    """hmt_msgs/Keypoints2D."""
    return messages.create(
        'hmt_msgs/msg/Keypoints2D',
        header=header_message(messages, content.stamp_ns, content.frame_id),
        names=list(content.names),
        u=content.pixels[:, 0],
        v=content.pixels[:, 1],
        covariance=content.covariances.reshape(-1),
        confidence=content.confidence,
    )
