"""Times in nanoseconds and headers."""

from __future__ import annotations

import struct
from typing import Any

from msg_tools.messages.message_error import MessageError
from msg_tools.messages.message_types import MessageFactory

SECOND_NS = 1_000_000_000
FRAME_ID = 'camera_optical_frame'  # of a camera whose messages name no frame
START_NS = 1_700_000_000 * SECOND_NS  # stamp of the first image of what no clock has stamped
EARLIEST_NS = -(2**31) * SECOND_NS  # that a message can hold
_STAMP_AT, _STAMP_SIZE = 4, 8  # bytes of CDR


def time_message(messages: MessageFactory, stamp_ns: int) -> Any:
    """builtin_interfaces/Time of a time in ns since 1970."""
    seconds, nanoseconds = divmod(int(stamp_ns), SECOND_NS)
    return messages.create('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)


def time_ns(time: Any) -> int:
    """Time in ns of a builtin_interfaces/Time, `message.header.stamp` for example.

    Raises:
        MessageError: a second or more of nanoseconds.
    """
    nanoseconds = int(time.nanosec)
    if nanoseconds >= SECOND_NS:
        text = f'stamp has {nanoseconds} nanoseconds, wanted less than {SECOND_NS}'
        raise MessageError(text, 'stamp')
    return int(time.sec) * SECOND_NS + nanoseconds


def stamp_in(data: bytes) -> int:
    """Stamp, ns, of the header that opens a message of CDR bytes; 0 if they have none."""
    # Behind the encapsulation, whose second byte tells the order of bytes.
    if len(data) < _STAMP_AT + _STAMP_SIZE:
        return 0
    order = '<' if data[1] & 1 else '>'
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, _STAMP_AT)
    return int(seconds) * SECOND_NS + int(nanoseconds) if nanoseconds < SECOND_NS else 0


def header_message(messages: MessageFactory, stamp_ns: int, frame_id: str) -> Any:
    """std_msgs/Header."""
    return messages.create(
        'std_msgs/msg/Header', stamp=time_message(messages, stamp_ns), frame_id=frame_id
    )
