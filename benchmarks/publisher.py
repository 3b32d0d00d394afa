"""A publisher in a process of its own, to be killed: messages of a file, again and again.

python -m benchmarks.publisher FILE TOPIC TYPE FIRST_STAMP_NS RATE
"""

from __future__ import annotations

import struct
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from itertools import count
from pathlib import Path

STEP_NS = 100_000_000
# Where the stamp of a header stands that opens a message, behind the encapsulation.
_STAMP_AT = 4


def as_file(messages: Sequence[bytes]) -> bytes:
    """The content of a file of messages."""
    return b''.join(struct.pack('<I', len(data)) + data for data in messages)


def with_stamp(data: bytes, stamp_ns: int) -> bytes:
    """A message that opens with a header, with another stamp."""
    stamp = struct.pack('<iI', *divmod(stamp_ns, 10**9))
    return data[:_STAMP_AT] + stamp + data[_STAMP_AT + len(stamp) :]


def main(argv: list[str]) -> int:
    """Publishes until it is killed."""
    file, topic, msgtype, first, rate = argv
    import rclpy

    messages, content = [], Path(file).read_bytes()
    while content:
        (length,) = struct.unpack_from('<I', content)
        messages.append(content[4 : 4 + length])
        content = content[4 + length :]
    package, _, name = msgtype.split('/')
    rclpy.init()
    node = rclpy.create_node('publisher')
    publisher = node.create_publisher(getattr(import_module(f'{package}.msg'), name), topic, 10)
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    for number in count():
        stamp = int(first) + number * STEP_NS
        publisher.publish(with_stamp(messages[number % len(messages)], stamp))
        time.sleep(1.0 / float(rate))
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
