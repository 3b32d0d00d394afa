"""Decodes the videos in bags (H.264 and similar, one packet per message) to images.

The messages are sensor_msgs/CompressedImage or foxglove_msgs/CompressedVideo. PyAV decodes them; it
is imported only here, and only if a bag has such a video.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np

from msg_tools.bags.bag_metadata import BagError
from msg_tools.bags.bag_reader import BagMessage, BagReader, Topic
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import MAX_PIXELS, image_message
from msg_tools.messages.message_types import RosbagsMessages

VIDEO_TYPE = 'foxglove_msgs/msg/CompressedVideo'
_TYPES = ('sensor_msgs/msg/CompressedImage', VIDEO_TYPE)
_MAX_WAITING_PACKETS = 32  # maximum number of packets that are not decoded yet
# Maps the format in a message to the name of its decoder.
_CODECS = {'h264': 'h264', 'h265': 'hevc', 'hevc': 'hevc', 'vp9': 'vp9', 'av1': 'av1'}


def is_video(bag: BagReader, topic: Topic) -> bool:
    """Whether the first message of a topic belongs to a video.

    Raises:
        BagError: the message belongs to a video, but PyAV is not installed.
    """
    if topic.msgtype not in _TYPES or not topic.message_count:
        return False
    try:
        codec = _codec_of(next(bag.messages([topic.name])).message)
    except (BagError, StopIteration):
        return False  # the reader of the images reports the damage
    if codec is not None:
        _library(topic.name, codec)
    return codec is not None


def with_pictures(messages: Iterator[BagMessage], topic: str) -> Iterator[BagMessage]:
    """Replaces each video packet on a topic by a sensor_msgs/Image, bgr8.

    Packets before the first key frame and damaged packets are left out. Other messages are
    unchanged.

    Raises:
        BagError: no packet could be decoded, or PyAV is not installed.
    """
    video: _Video | None = None
    for stored in messages:
        codec = None
        if stored.topic == topic and stored.msgtype in _TYPES:
            with suppress(BagError):  # the receiver of the message reports it
                codec = _codec_of(stored.message)
        if codec is None:
            yield stored
            continue
        video = video or _Video(topic, codec)
        yield from video.pictures(stored)
    if video is not None:
        yield from video.pictures(None)
        if not video.started:
            raise BagError(
                f'{topic}: none of its {video.count} packets of video is a complete key frame'
            )


def _codec_of(message: Any) -> str | None:
    return _CODECS.get(str(message.format).strip().lower())


def _library(topic: str, codec: str) -> Any:
    try:
        return importlib.import_module('av')
    except ImportError as error:
        raise BagError(
            f'the images on {topic} are {codec} video, which needs PyAV ({error}): pip install av'
        ) from error


class _Video:
    """The video decoder of a topic.

    Attributes:
        count: number of packets received so far.
        started: whether a key frame was decoded.
    """

    def __init__(self, topic: str, codec: str) -> None:
        self._av = _library(topic, codec)
        self._decoder = self._av.CodecContext.create(codec, 'r')
        self._decoder.options = {'max_pixels': str(MAX_PIXELS)}
        self._packets: dict[int, BagMessage] = {}  # packets that are not decoded yet
        self.count, self.started = 0, False

    def pictures(self, stored: BagMessage | None) -> Iterator[BagMessage]:
        """Decodes a packet and yields complete pictures; None marks the end of the video."""
        packet = None
        if stored is not None:
            packet = self._av.Packet(np.asarray(stored.message.data, dtype=np.uint8).tobytes())
            packet.pts = self.count
            self._packets[self.count] = stored
            self._packets.pop(self.count - _MAX_WAITING_PACKETS, None)
            self.count += 1
        try:
            frames = self._decoder.decode(packet)
        except self._av.error.FFmpegError:
            return
        for frame in frames:
            self.started = self.started or bool(frame.key_frame)
            source = self._packets.pop(frame.pts, None)
            if self.started and source is not None:
                yield _with_picture(source, frame.to_ndarray(format='bgr24'))


def image_stamp(message: Any) -> int:
    """Stamp of an image or of a packet of a video, ns."""
    return time_ns(message.header.stamp if hasattr(message, 'header') else message.timestamp)


def _with_picture(stored: BagMessage, picture: Any) -> BagMessage:
    message = stored.message
    frame_id = str(getattr(message, 'header', message).frame_id)
    stamp = image_stamp(message)
    return stored.with_message(image_message(RosbagsMessages(), picture, stamp, frame_id))
