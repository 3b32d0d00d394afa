"""Messages to CDR bytes and back, without ROS.

CDR leaves the bytes that pad a field to its alignment undefined, and the middleware of ROS 2 fills
them with whatever its buffer held before; `rclpy.serialization.serialize_message` even appends some
where a sequence is empty. `serialise` writes zeros into the padding and nothing behind the message:
equal messages have equal bytes. A node that publishes these bytes (`Publisher.publish` takes them)
puts the same bytes on the wire, and so into a recorded bag, as an offline run writes; only at the
end the middleware may append some, up to a multiple of four, which `canonical` takes away again.
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
# Values that a message may have, at most 100 bytes and 1 us each, and those that one record of the
# budget pays for.
MAX_VALUES, _VALUES_PER_RECORD = 4_000_000, 16


def serialise(message: Any) -> bytes:
    """Little-endian CDR bytes, with their encapsulation header, by the types of `typestore()`."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__, little_endian=True))


def deserialise(
    data: bytes | memoryview,
    msgtype: str,
    types: Typestore | None = None,
    budget: Budget | None = None,
) -> Any:
    """Message of CDR bytes; its arrays are read-only views of `data`.

    Bytes behind the message are ignored, as ROS does: recorders that use `serialize_message` leave
    some.

    Args:
        data: with encapsulation header, of either byte order.
        msgtype: for example 'hmt_msgs/msg/Body'.
        types: where the type is looked up; None: `typestore()`.
        budget: of the file that the bytes are of; each byte from outside may claim to be a message
            of its own, for which an object is made.

    Raises:
        Exception: of many kinds, where the bytes are not a message of this type.
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
            raise ValueError(f'{len(view)} bytes may hold {values} values, wanted {MAX_VALUES}')
        budget.spend(records=values // _VALUES_PER_RECORD)
    message, end = read(body, 0, definition.cls, store)
    if end > len(body):
        # rosbags before 0.11 takes the bytes that are there for the whole of a string.
        raise ValueError(f'it breaks off after {len(view)} bytes')
    return message


@lru_cache(maxsize=256)
def _extent_of_type(types: Typestore, msgtype: str) -> Extent:
    return extent_of((Nodetype.NAME, msgtype), types.fielddefs, {})


def canonical(data: bytes | memoryview, msgtype: str) -> bytes:
    """The same message as CDR bytes whose padding is zero, as `serialise` writes them."""
    return serialise(deserialise(data, msgtype))
