"""Common parts of the readers of MCAP and SQLite files."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from msg_tools.bags.bag_metadata import BagError, reason
from msg_tools.files.budget import BudgetError

# Maximum size of a message or a chunk, bytes; the largest accepted images have 2**26 pixels.
MAX_CHUNK_BYTES = 2**28
NEVER_NS = 2**64  # later than any log time
MAX_TOPICS = 2**16  # maximum number of topics in all files of a bag, as in MCAP


class Channel(NamedTuple):
    """Description of the messages of one topic in a file.

    Attributes:
        topic: name as in the file, with or without a leading slash.
        msgtype: type as in the file; '' if unknown.
        encoding: encoding of the messages; 'cdr' for ROS 2.
        definition_encoding: 'ros2msg' for the text of a .msg file; '' without a definition.
        definition: text of the message definition.
    """

    topic: str
    msgtype: str
    encoding: str
    definition_encoding: str
    definition: str


class StoredMessage(NamedTuple):
    """A stored message with its log time, ns; an entry without a channel is only a time mark."""

    log_time: int
    channel: Channel | None
    data: bytes


@contextmanager
def as_bag_errors(name: str) -> Iterator[None]:
    """Turns any exception into a BagError, because libraries do not document their exceptions."""
    try:
        yield
    except OSError as error:
        raise BagError(f'{name} can not be read: {reason(error)}') from error
    except BudgetError as error:
        raise BagError(f'{name} is refused: {reason(error)}') from error
    except Exception as error:
        raise BagError(f'{name} is damaged: {type(error).__name__}: {reason(error)}') from error
