"""Images of a bag as JPEGs, with a limit on their total size for the page."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from hmt_ros.app.replay.inputs import CAMERA_INFO_TYPE, OVERLAY, recorded_input
from hmt_ros.body import Camera
from hmt_ros.inference.arrays import Image
from hmt_ros.sessions.image_inputs import COMPRESSED_TYPE, IMAGE_TYPE
from msg_tools import BagReader
from msg_tools.bags.video_messages import with_pictures
from msg_tools.messages.camera_info import camera_from_info
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import decode_image, encode_jpeg

# Width, px, and JPEG quality of each level, from best to smallest.
_QUALITIES = (
    (640, 80),
    (640, 65),
    (480, 65),
    (480, 50),
    (360, 50),
    (320, 40),
    (240, 35),
    (160, 30),
)


@dataclass(frozen=True)
class ImageSource:
    """The source of the images of a report.

    Attributes:
        bag: path of the bag.
        topic: topic of the images.
        camera_info: topic of the calibration; None if the modes are already drawn on the images.
    """

    bag: Path
    topic: str
    camera_info: str | None


@dataclass(eq=False)
class FilmStrip:
    """Images by stamp.

    Attributes:
        camera: camera of the images; None if unknown.
        size: (width, height) of the images in the bag, px; (0, 0) without images.
        jpegs: JPEG files of the images, scaled down.
        kept: some of the images at their full size, (H, W, 3) BGR.
    """

    camera: Camera | None = None
    size: tuple[int, int] = (0, 0)
    jpegs: dict[int, bytes] = field(default_factory=dict)
    kept: dict[int, Image] = field(default_factory=dict)


def image_source(
    out: Path, images: Path | None, image_topic: str | None, camera_info_topic: str | None
) -> ImageSource | None:
    """Finds the images that belong to a bag of mixtures; returns None if missing.

    They are the images in the bag `images`, else the images in `out` if it has a calibration, else
    the tracker's overlay images in `out`.

    Args:
        out: bag of the mixtures.
        images: bag of the images; None if not given.
        image_topic, camera_info_topic: names that replace the automatic choice.

    Raises:
        BagError: wanted images or calibration are missing, or are ambiguous.
    """
    path = out if images is None else images
    with BagReader(path) as bag:
        if images is None and image_topic is None:
            found = [topic.name for topic in bag.topics_of(IMAGE_TYPE, COMPRESSED_TYPE)]
            drawn = [name for name in found if name.endswith(OVERLAY)]
            recorded = [name for name in found if name not in drawn]
            if not recorded or not bag.topics_of(CAMERA_INFO_TYPE):
                return ImageSource(path, drawn[0], None) if drawn else None
            if len(recorded) == 1:
                image_topic = recorded[0]
        chosen = recorded_input(bag, image_topic, camera_info_topic)
        return ImageSource(path, chosen.image.name, chosen.camera_info.name)


def film_strip(
    source: ImageSource,
    stamps: Collection[int],
    allowed: int,
    *,
    keep: Collection[int] = (),
    progress: Callable[[int], object] = lambda count: None,
) -> FilmStrip:
    """Reads the images at the given stamps as JPEGs.

    Each image gets an equal part of the bytes; once an image does not fit, all later images are
    scaled down as well.

    Args:
        source: source of the images.
        stamps: stamps of the wanted images.
        allowed: maximum total size of the JPEGs, bytes.
        keep: stamps of the images to keep at full size as well.
        progress: called with the number of images that were read.

    Raises:
        ValueError: no image has a wanted stamp, an image can not be decoded, or sizes differ.
    """
    wanted = set(stamps)
    result = FilmStrip()
    seen: list[int] = []
    level, left = 0, allowed
    with BagReader(source.bag) as bag:
        for stored in with_pictures(bag.messages([source.topic]), source.topic):
            progress(1)
            stamp = time_ns(stored.message.header.stamp)
            if stamp not in wanted and stored.log_time_ns in wanted:
                stamp = stored.log_time_ns  # the bag was tracked with --times log
            seen.append(stamp)
            if stamp not in wanted or stamp in result.jpegs:
                continue
            image = stored.content(decode_image)
            size = image.shape[1], image.shape[0]
            if result.size not in ((0, 0), size):
                raise ValueError(
                    f'{source.bag}: images on {source.topic} have sizes {result.size[0]}x'
                    f'{result.size[1]} and {size[0]}x{size[1]}, wanted one'
                )
            result.size = size
            if stamp in keep:
                result.kept[stamp] = image
            jpeg, level = _small(image, allowed // len(wanted), level)
            if len(jpeg) <= left:
                result.jpegs[stamp] = jpeg
                left -= len(jpeg)
        if result.size == (0, 0):
            raise ValueError(
                f'{source.bag}: none of the images on {source.topic}, '
                f'{min(seen)} to {max(seen)} ns, has the stamp of a mixture, '
                f'{min(wanted)} to {max(wanted)} ns: is this the bag that was tracked?'
            )
        if source.camera_info is not None:
            info = next(bag.messages([source.camera_info]))
            result.camera = info.content(partial(camera_from_info, image_size=result.size))
    return result


def _small(image: Image, allowed: int, level: int) -> tuple[bytes, int]:
    """Best JPEG of an image within `allowed` bytes, or else the smallest JPEG, and the level."""
    while True:
        width, quality = _QUALITIES[level]
        scaled = image
        if image.shape[1] > width:
            height = max(round(image.shape[0] * width / image.shape[1]), 1)
            resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
            scaled = np.asarray(resized, dtype=np.uint8)
        jpeg = encode_jpeg(scaled, quality)
        if len(jpeg) <= allowed or level == len(_QUALITIES) - 1:
            return jpeg, level
        level += 1
