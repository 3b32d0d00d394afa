"""A track that was recorded in a bag, with the images that it explains."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmt_ros.app.recorded_input import recorded_input
from hmt_ros.app.truth import POSE_MIXTURE
from hmt_ros.body import Camera
from msg_tools import BagReader
from msg_tools.camera_info import camera_from_info
from msg_tools.headers import time_ns
from msg_tools.images import decode_image
from msg_tools.pose_mixtures import pose_mixture_of

Array = NDArray[np.float64]
Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Moment:
    """The mixture at one time.

    Attributes:
        stamp_ns: of the image.
        weights: (K,) heaviest first.
        joints: (K, J, 3) camera optical frame, m.
    """

    stamp_ns: int
    weights: Array
    joints: Array


@dataclass(frozen=True, eq=False)
class RecordedTrack:
    """Mixtures over time.

    Attributes:
        joint_names: (J,).
        moments: in the order of time.
    """

    joint_names: tuple[str, ...]
    moments: list[Moment]


def read_track(path: Path, topic: str = 'pose_mixture') -> RecordedTrack:
    """The mixtures of a topic; of each the joints only.

    Raises:
        ValueError: no such topic, no messages, or messages that can not be understood.
    """
    moments = []
    names: tuple[str, ...] = ()
    with BagReader(path) as bag:
        for stored in bag.messages([bag.find_topic([POSE_MIXTURE], topic).name]):
            content = pose_mixture_of(stored.message, joint_names=names or None)
            names = content.joint_names
            order = np.argsort(-content.mixture.weights, kind='stable')
            moments.append(
                Moment(
                    content.stamp_ns,
                    content.mixture.weights[order],
                    content.joint_positions[order],
                )
            )
    return RecordedTrack(names, moments)


def read_images(path: Path, stamps: set[int]) -> tuple[Camera, dict[int, Image]]:
    """The camera of a bag, and some of its images by stamp.

    Raises:
        ValueError: no images, no calibration, or an image that can not be decoded.
    """
    images: dict[int, Image] = {}
    with BagReader(path) as bag:
        recorded = recorded_input(bag)
        for stored in bag.messages([recorded.image.name]):
            stamp = time_ns(stored.message.header.stamp)
            if stamp in stamps:
                images[stamp] = decode_image(stored.message)
        info = next(bag.messages([recorded.camera_info.name])).message
    if not images:
        raise ValueError(f'{path} has none of the images of the track')
    height, width = next(iter(images.values())).shape[:2]
    return camera_from_info(info, (width, height)), images
