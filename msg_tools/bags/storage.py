"""What the files of a bag have in common, whatever their format."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from msg_tools.bags.bag_metadata import BagError, reason
from msg_tools.files.budget import BudgetError

# Bytes of a message or a chunk: the largest images that are read have 2**26 pixels, uncompressed.
LARGEST = 2**28
NEVER = 2**64  # later than any log time
MAX_TOPICS = 2**16  # of a bag, those of each file counted; a file of MCAP has no more


class Channel(NamedTuple):
    """Description of the messages of one topic in a file.

    Attributes:
        topic: as written, with or without a leading slash.
        msgtype: as written; '' if the file does not contain it.
        encoding: 'cdr' for ROS 2.
        definition_encoding: 'ros2msg' for the text of a .msg file; '' when there is no definition.
        definition: text of the message definition.
    """

    topic: str
    msgtype: str
    encoding: str
    definition_encoding: str
    definition: str


class StoredMessage(NamedTuple):
    """A message as it lies in the file, with its log time, ns; without a channel, a mark."""

    log_time: int
    channel: Channel | None
    data: bytes


@contextmanager
def faults_told(name: str) -> Iterator[None]:
    """Turns what the libraries raise, which do not say what that may be, into BagError."""
    try:
        yield
    except OSError as error:
        raise BagError(f'{name} can not be read: {reason(error)}') from error
    except BudgetError as error:
        raise BagError(f'{name} is refused: {reason(error)}') from error
    except Exception as error:
        raise BagError(f'{name} is damaged: {type(error).__name__}: {reason(error)}') from error
