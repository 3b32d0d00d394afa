"""Converts times in nanoseconds, and headers."""

from __future__ import annotations

import struct
from typing import Any

from msg_tools.messages.message_error import MessageError
from msg_tools.messages.message_types import MessageFactory

SECOND_NS = 1_000_000_000
FRAME_ID = 'camera_optical_frame'  # default frame of a camera
START_NS = 1_700_000_000 * SECOND_NS  # default stamp of the first image
EARLIEST_NS = -(2**31) * SECOND_NS  # earliest time that a message can contain
_STAMP_OFFSET, _STAMP_SIZE = 4, 8  # offset and size of the stamp in CDR, bytes


def time_message(messages: MessageFactory, stamp_ns: int) -> Any:
    """builtin_interfaces/Time of a time in ns since 1970."""
    seconds, nanoseconds = divmod(int(stamp_ns), SECOND_NS)
    return messages.create('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)


def time_ns(time: Any) -> int:
    """Time in ns of a builtin_interfaces/Time, `message.header.stamp` for example.

    Raises:
        MessageError: the field nanosec is a second or more.
    """
    nanoseconds = int(time.nanosec)
    if nanoseconds >= SECOND_NS:
        text = f'stamp has {nanoseconds} nanoseconds, wanted less than {SECOND_NS}'
        raise MessageError(text, 'stamp')
    return int(time.sec) * SECOND_NS + nanoseconds


def stamp_in(data: bytes) -> int:
    """Stamp, ns, of the header at the start of a message in CDR bytes; 0 if invalid."""
    # The message follows a header of four bytes; the second byte gives the byte order.
    if len(data) < _STAMP_OFFSET + _STAMP_SIZE:
        return 0
    order = '<' if data[1] & 1 else '>'
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, _STAMP_OFFSET)
    return int(seconds) * SECOND_NS + int(nanoseconds) if nanoseconds < SECOND_NS else 0


def header_message(messages: MessageFactory, stamp_ns: int, frame_id: str) -> Any:
    """Makes a std_msgs/Header."""
    return messages.create(
        'std_msgs/msg/Header', stamp=time_message(messages, stamp_ns), frame_id=frame_id
    )
