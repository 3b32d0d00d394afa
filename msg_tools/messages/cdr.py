"""Converts messages to CDR bytes and back, without ROS.

CDR does not define the values of padding bytes; the ROS 2 middleware leaves old buffer content in
them, and `rclpy.serialization.serialize_message` even appends bytes after an empty sequence.
`serialise` writes zeros into the padding and nothing after the message, so that equal messages have
equal bytes. A node that publishes these bytes (`Publisher.publish` accepts them) sends and records
the same bytes as an offline run writes. The middleware only pads the bytes to a multiple of four;
`canonical` removes this padding.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from msg_tools.files.budget import Budget
from msg_tools.messages.definitions import Extent, extent_of
from msg_tools.messages.message_types import typestore

_HEADER_BYTES = 4
# Maximum number of values in a message (each takes up to 100 bytes and 1 us), and number of values
# that are charged as one record of the budget.
MAX_VALUES, _VALUES_PER_RECORD = 4_000_000, 16


def serialise(message: Any) -> bytes:
    """Little-endian CDR bytes with encapsulation header, for a message of `typestore()`."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__, little_endian=True))


def deserialise(
    data: bytes | memoryview,
    msgtype: str,
    types: Typestore | None = None,
    budget: Budget | None = None,
) -> Any:
    """Reads a message from CDR bytes; its arrays are read-only views of `data`.

    Bytes after the message are ignored, as in ROS, because recorders that use `serialize_message`
    append some.

    Args:
        data: CDR bytes with encapsulation header, in either byte order.
        msgtype: type, for example 'hmt_msgs/msg/Body'.
        types: types that include `msgtype`; None selects `typestore()`.
        budget: budget of the file that contains the bytes, because a few untrusted bytes can
            declare many nested messages, which all become objects.

    Raises:
        Exception: the bytes are not a message of this type; any class of exception is possible.
    """
    store = typestore() if types is None else types
    view = memoryview(data).toreadonly()
    if len(view) < _HEADER_BYTES or view[0] != 0 or view[1] > 1:
        raise ValueError(f'its encapsulation is {bytes(view[:_HEADER_BYTES])!r}, wanted plain CDR')
    definition = store.get_msgdef(msgtype)
    read = definition.deserialize_cdr_le if view[1] else definition.deserialize_cdr_be
    body = view[_HEADER_BYTES:]
    if budget is not None:
        extent = _extent_of_type(store, msgtype)
        values = extent.values + int(extent.density * len(body))
        if values > MAX_VALUES:
            raise ValueError(
                f'{len(view)} bytes may hold {values} values, wanted at most {MAX_VALUES}'
            )
        budget.spend(records=values // _VALUES_PER_RECORD)
    message, end = read(body, 0, definition.cls, store)
    if end > len(body):
        # rosbags before 0.11 does not detect a string that is cut off.
        raise ValueError(f'it breaks off after {len(view)} bytes')
    return message


@lru_cache(maxsize=256)
def _extent_of_type(types: Typestore, msgtype: str) -> Extent:
    return extent_of((Nodetype.NAME, msgtype), types.fielddefs, {})


def canonical(data: bytes | memoryview, msgtype: str) -> bytes:
    """The same message as CDR bytes with zero padding, as `serialise` writes them."""
    return serialise(deserialise(data, msgtype))
