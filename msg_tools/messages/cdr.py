"""Messages to CDR bytes and back, without ROS.

CDR leaves the bytes that pad a field to its alignment undefined, and the middleware of ROS 2 fills
them with whatever its buffer held before; `rclpy.serialization.serialize_message` even appends some
where a sequence is empty. `serialise` writes zeros into the padding and nothing behind the message:
equal messages have equal bytes. A node that publishes these bytes (`Publisher.publish` takes them)
puts the same bytes on the wire, and so into a recorded bag, as an offline run writes; only at the
end the middleware may append some, up to a multiple of four, which `canonical` takes away again.
"""

from __future__ import annotations

from contextlib import suppress
from struct import unpack_from
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde.utils import SIZEMAP
from rosbags.typesys.store import Typestore

from msg_tools.files.budget import Budget
from msg_tools.messages.definitions import Extent, extent_of
from msg_tools.messages.message_types import typestore

_HEADER_BYTES = 4
# Memory that a value takes, and what all those of one message may take.
_VALUE_BYTES, _MAX_VALUES = 64, 2**20


def serialise(message: Any) -> bytes:
    """Little-endian CDR bytes, with their encapsulation header, by the types of `typestore()`."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__, little_endian=True))


def deserialise(
    data: bytes | memoryview,
    msgtype: str,
    types: Typestore | None = None,
    budget: ValueBudget | None = None,
) -> Any:
    """Message of CDR bytes; its arrays are read-only views of `data`.

    Bytes behind the message are ignored, as ROS does: recorders that use `serialize_message` leave
    some.

    Args:
        data: with encapsulation header, of either byte order.
        msgtype: for example 'hmt_msgs/msg/Body'.
        types: where the type is looked up; None: `typestore()`.
        budget: of the file that the bytes are of.

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
        budget.spend(body, msgtype, store, little=bool(view[1]))
    message, end = read(body, 0, definition.cls, store)
    if end > len(body):
        # rosbags before 0.11 takes the bytes that are there for the whole of a string.
        raise ValueError(f'it breaks off after {len(view)} bytes')
    return message


class ValueBudget:
    """What the values of the messages of a file may take together.

    In bytes from outside each byte may claim to be a message of its own, for which an object is
    made. What the length of a message allows at most is spent first, as this is quick, and when
    that is used up, what each message has.

    Args:
        size: of the file, bytes.
    """

    def __init__(self, size: int) -> None:
        self._bounds, self._counts = Budget(size), Budget(size)
        self._extents: dict[Typestore, dict[str, Extent]] = {}

    def spend(self, body: memoryview, msgtype: str, types: Typestore, *, little: bool) -> None:
        """Takes what a message needs.

        Args:
            body: of the message, without encapsulation.

        Raises:
            Exception: of many kinds, where the bytes are not a message of this type, or too many
                values; one line.
        """
        extents = self._extents.setdefault(types, {})
        extent = extent_of((Nodetype.NAME, msgtype), types.fielddefs, extents)
        bound = extent.values + int(extent.density * len(body))
        if bound <= _MAX_VALUES:
            with suppress(ValueError):  # the values are counted
                self._bounds.spend(unpacked=_VALUE_BYTES * bound)
                return
        values = _Values(body, '<I' if little else '>I', types)
        values.skip((Nodetype.NAME, msgtype), 0)
        self._counts.spend(unpacked=_VALUE_BYTES * values.count)


class _Values:
    """The values in the bytes of a message, which are counted before objects are made of them.

    Attributes:
        count: how many there are; an array of numbers is one.
    """

    def __init__(self, body: memoryview, length: str, types: Typestore) -> None:
        self._body, self._length, self._types = body, length, types
        self.count = 0

    def skip(self, description: Any, at: int) -> int:
        """Counts a value, given as `rosbags` describes fields, and returns where it ends.

        Raises:
            ValueError: too many.
            struct.error: the message ends before.
        """
        self.count += 1
        if self.count > _MAX_VALUES:
            raise ValueError(f'it has more than {_MAX_VALUES} values')
        kind, detail = description
        if kind == Nodetype.NAME:
            fields: Any = self._types.fielddefs[detail][1]
            for _, each in fields:
                at = self.skip(each, at)
            return at
        count = 1
        if kind != Nodetype.BASE:
            one, count = detail
            detail = one[1]
            if kind == Nodetype.SEQUENCE:
                count, at = self._number(at)
            if detail[0] not in SIZEMAP:
                for _ in range(count):
                    at = self.skip(one, at)
                return at
        if detail[0] == 'string':
            length, at = self._number(at)
            return at + length
        size = SIZEMAP[detail[0]]
        return (at + size - 1 & -size) + count * size if count else at

    def _number(self, at: int) -> tuple[int, int]:
        """A length, and where it ends."""
        at = at + 3 & -4
        return unpack_from(self._length, self._body, at)[0], at + 4


def canonical(data: bytes | memoryview, msgtype: str) -> bytes:
    """The same message as CDR bytes whose padding is zero, as `serialise` writes them."""
    return serialise(deserialise(data, msgtype))
