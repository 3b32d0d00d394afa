"""Messages to CDR bytes and back, without ROS.

CDR leaves the bytes that pad a field to its alignment undefined, and the middleware of ROS 2 fills them
with whatever its buffer held before. `serialise` always writes zeros there: equal messages have equal
bytes. A node that publishes these bytes (`Publisher.publish` takes them) puts the same bytes on the
wire, and so into a recorded bag, as an offline run writes.
"""

from __future__ import annotations

from typing import Any

from msg_tools.typestore import typestore


def serialise(message: Any) -> bytes:
    """Little-endian CDR bytes, with their encapsulation header, of a message of `typestore()`."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__, little_endian=True))


def deserialise(data: bytes | memoryview, msgtype: str) -> Any:
    """Message of CDR bytes; its arrays are read-only views of `data`."""
    return typestore().deserialize_cdr(memoryview(data), msgtype)


def canonical(data: bytes | memoryview, msgtype: str) -> bytes:
    """The same message as CDR bytes whose padding is zero."""
    return serialise(deserialise(data, msgtype))
