"""Reads a bag: a rosbag2 folder, or a single .mcap or .db3 file, also compressed with zstd.

Messages are sorted by log time; messages with equal log times keep the order of the files. Only the
chunks that contain the current log time are in memory, never a whole file. Every fault in a bag
raises a `BagError` with a message of one line. A bag that was cut off by a crash is read up to its
last complete message, with a warning in the log.

    with BagReader('walk') as bag:
        topic = bag.find_topic(['sensor_msgs/msg/CompressedImage'])
        for stored in bag.messages([topic.name]):
            print(stored.log_time_ns, stored.message.format)
"""

from __future__ import annotations

import heapq
import logging
import os
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from itertools import islice
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import zstandard
from rosbags.typesys.store import Typestore

from msg_tools.bags.bag_metadata import BagError, read_file_names, reason
from msg_tools.bags.mcap_file import MAGIC as _MCAP_MAGIC
from msg_tools.bags.mcap_file import McapFile
from msg_tools.bags.sqlite_file import MAGIC as _SQLITE_MAGIC
from msg_tools.bags.sqlite_file import SqliteFile
from msg_tools.bags.storage import (
    MAX_CHUNK_BYTES,
    MAX_TOPICS,
    Channel,
    StoredMessage,
    as_bag_errors,
)
from msg_tools.files.budget import Budget, BudgetError
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.message_types import adopted, typestore_of_definition

_log = logging.getLogger(__name__)

Content = TypeVar('Content')

_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'

_OWN_PREFIX = 'hmt_msgs/'
# Maximum number of message definitions per topic, and of names in an error message.
_MAX_DEFINITIONS, _MAX_NAMES = 4, 20
_PIECE_BYTES = 2**20


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: name as in the bag, with or without a leading slash.
        msgtype: type, for example 'sensor_msgs/msg/Image'; '' if unknown.
        encoding: encoding of the messages; 'cdr' for ROS 2.
        message_count: number of messages according to the statistics of the bag.
    """

    name: str
    msgtype: str
    encoding: str
    message_count: int


@dataclass(frozen=True)
class BagMessage:
    """A message of a bag; its bytes are deserialised when `message` is first used.

    Attributes:
        path: path of the bag.
        topic: name of the topic as in the bag.
        msgtype: type, for example 'sensor_msgs/msg/Image'.
        log_time_ns: time at which the message was recorded, ns.
        data: CDR bytes, as stored.
    """

    path: Path
    topic: str
    msgtype: str
    log_time_ns: int
    data: bytes = field(repr=False)
    _deserialise: Callable[[BagMessage], Any] = field(repr=False)

    @cached_property
    def message(self) -> Any:
        """The message, with the fields of its type; arrays are read-only.

        Raises:
            BagError: the bytes do not match the type, or the type is unknown.
        """
        return self._deserialise(self)

    def content(self, read: Callable[[Any], Content]) -> Content:
        """Returns the result of `read` for the message.

        Raises:
            ValueError: the bytes do not match the type, or `read` raises ValueError; the message is
                one line with topic and time.
        """
        message = self.message
        try:
            return read(message)
        except ValueError as error:
            where = f'{self.path}: {self.topic} at {self.log_time_ns} ns'
            raise ValueError(f'{where}: {error}') from error

    def with_message(self, message: Any) -> BagMessage:
        """Returns a copy that contains the given `rosbags` message and no bytes."""
        kind = message.__msgtype__
        return BagMessage(self.path, self.topic, kind, self.log_time_ns, b'', lambda _: message)


class BagReader(AbstractContextManager['BagReader']):
    """A bag that is open for reading.

    Args:
        path: folder with metadata.yaml, or a file.

    Raises:
        BagError: the path is not a bag, or no part of the bag can be read.

    Attributes:
        path: path of the bag, as given.
        topics: topics by name, in the order of the bag.
        cut_off: files whose end is missing because the recorder was killed.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._typestores: dict[Channel, Typestore] = {}
        self._scratch = ExitStack()
        paths = self._storage_paths()
        self._size = sum(file.stat().st_size for file in paths)
        budget = Budget(self._size)
        try:
            self._files: list[SqliteFile | McapFile] = []
            topics = 0
            for each in paths:
                self._files.append(self._open_file(each, budget))
                topics += len(self._files[-1].counts)
                if topics > MAX_TOPICS:
                    raise BagError(f'{self.path} has more than {MAX_TOPICS} topics in its files')
        except BaseException:
            self.close()
            raise
        self.topics: dict[str, Topic] = {}
        self._channels: defaultdict[str, set[Channel]] = defaultdict(set)  # by topic
        for file in self._files:
            for channel, count in file.counts.items():
                self._channels[channel.topic].add(channel)
                known = self.topics.get(channel.topic)
                self.topics[channel.topic] = Topic(
                    channel.topic,
                    known.msgtype if known else _full_name(channel.msgtype),
                    known.encoding if known else channel.encoding,
                    count + (known.message_count if known else 0),
                )
        self.cut_off = tuple(file.name for file in self._files if file.cut_off)
        for name in self.cut_off:
            _warn_of_cut_off(name)

    def close(self) -> None:
        """Removes the temporary files with decompressed content."""
        self._scratch.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def message_count(self, topics: Iterable[str] | None = None) -> int:
        """Number of messages on the given topics, or on all topics.

        Raises:
            BagError: no such topic.
        """
        names = self.topics if topics is None else {self.topic(name).name for name in topics}
        return sum(self.topics[name].message_count for name in names)

    def topics_of(self, *msgtypes: str) -> list[Topic]:
        """Topics of the given types that have messages."""
        return [x for x in self.topics.values() if x.msgtype in msgtypes and x.message_count]

    def topic(self, name: str) -> Topic:
        """The topic with the given name, with or without a leading slash.

        A relative name that is missing in the root namespace selects the topic of that name in
        another namespace, if only one namespace has such a topic.

        Raises:
            BagError: there is no topic of that name, or several namespaces have one.
        """
        for candidate in (name, f'/{name}', name.removeprefix('/')):
            if candidate in self.topics:
                return self.topics[candidate]
        inside = [x for x in self.topics if not name.startswith('/') and x.endswith(f'/{name}')]
        if len(inside) == 1:
            return self.topics[inside[0]]
        if inside:
            raise BagError(f'{self.path} has several topics {name}: name one of {_listed(inside)}')
        raise BagError(f'{self.path} has no topic {name}; it has {self._topic_names()}')

    def find_topic(self, msgtypes: Iterable[str], name: str | None = None) -> Topic:
        """The only topic of the given types, or the topic with the given name.

        Args:
            msgtypes: accepted types.
            name: name of the topic, required if several topics have these types; None otherwise.

        Raises:
            BagError: there is no such topic or more than one, its type is not accepted, or it has
                no messages.
        """
        wanted = list(msgtypes)
        short = ' or '.join(msgtype.rpartition('/')[2] for msgtype in wanted)
        if name is not None:
            topic = self.topic(name)
            if topic.msgtype not in wanted:
                raise BagError(
                    f'{self.path}: topic {topic.name} has messages of type '
                    f'{topic.msgtype or "unknown"}, wanted {short}'
                )
        else:
            found = [topic for topic in self.topics.values() if topic.msgtype in wanted]
            used = self.topics_of(*wanted)
            if len(used) > 1:
                names = _listed([topic.name for topic in used])
                raise BagError(f'{self.path} has several topics of {short}: name one of {names}')
            if not found:
                raise BagError(
                    f'{self.path} has no topic of type {short}; it has {self._topic_names()}'
                )
            topic = (used or found)[0]
        if not topic.message_count:
            raise BagError(f'{self.path}: topic {topic.name} has no messages')
        return topic

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[BagMessage]:
        """Yields messages by log time, then by position in the bag.

        Args:
            topics: names of topics, with or without leading slash; None for all topics.

        Raises:
            BagError: a topic does not exist, is not CDR, or has two types; or the bag is damaged
                (raised after the intact messages).
        """
        if topics is None:
            return self._merged(self.topics)
        names = {self.topic(name).name for name in topics}
        for name in names:
            channels = self._channels[name]
            kinds = {f'{_full_name(x.msgtype)} as {x.encoding}' for x in channels}
            if len(kinds) > 1:
                raise BagError(
                    f'{self.path}: topic {name} has messages of several kinds: '
                    f'{" and ".join(sorted(kinds)[:_MAX_NAMES])}'
                )
            if len(channels) > _MAX_DEFINITIONS:
                raise BagError(f'{self.path}: topic {name} has {len(channels)} definitions')
            self._check_encoding(name, self.topics[name].encoding)
        return self._merged(names)

    def _merged(self, names: Collection[str]) -> Iterator[BagMessage]:
        budget = Budget(self._size)
        found = (_from_its_start(file, names, budget) for file in self._files)
        for stored in heapq.merge(*found, key=attrgetter('log_time')):
            if stored.channel is not None:
                yield BagMessage(
                    self.path,
                    stored.channel.topic,
                    _full_name(stored.channel.msgtype),
                    stored.log_time,
                    stored.data,
                    partial(self._deserialise, stored.channel, budget),
                )

    def _deserialise(self, channel: Channel, budget: Budget, stored: BagMessage) -> Any:
        self._check_encoding(stored.topic, channel.encoding)
        what = f'{self.path}: message of {stored.topic} at {stored.log_time_ns} ns'
        data = stored.data
        try:
            store = self._typestores.get(channel)
            if store is None:
                store = self._typestores[channel] = typestore_of_definition(
                    stored.msgtype,
                    channel.definition_encoding,
                    channel.definition,
                )
            # Bags can compress single messages; an uncompressed CDR message never starts with these
            # bytes.
            if data[:4] == _ZSTD_MAGIC:
                data = b''.join(_decompressed(data, budget, MAX_CHUNK_BYTES))
            message = deserialise(data, stored.msgtype, store, budget)
            return adopted(message, store) if stored.msgtype.startswith(_OWN_PREFIX) else message
        except Exception as error:
            # Generated code reads untrusted bytes here, and its exceptions are not documented.
            raise BagError(
                f'{what} can not be read as {stored.msgtype or "unknown type"}: {reason(error)}'
            ) from error

    def _check_encoding(self, topic: str, encoding: str) -> None:
        if encoding != 'cdr':
            raise BagError(
                f'{self.path}: messages of {topic} are encoded as {encoding!r}, wanted cdr as '
                'ROS 2 records it'
            )

    def _topic_names(self) -> str:
        return _listed(self.topics) or 'none'

    # Files

    def _storage_paths(self) -> list[Path]:
        if os.path.isfile(self.path):  # noqa: PTH113 - also False for impossible names
            return [self.path]
        if not os.path.isdir(self.path):  # noqa: PTH112
            raise BagError(
                f'{self.path} can not be read: No such file or folder (pipes are neither)'
            )
        paths = [self.path / name for name in read_file_names(self.path)]
        for path in paths:
            if not os.path.isfile(path):  # noqa: PTH113 - also False for impossible names
                raise BagError(
                    f'{self.path}: the file {path.name[:100]}, which its metadata names, is missing'
                )
        return paths

    def _open_file(self, path: Path, budget: Budget) -> McapFile | SqliteFile:
        name = str(path)
        with as_bag_errors(name):
            magic = _first_bytes(path)
            if magic.startswith(_ZSTD_MAGIC):
                path = self._decompressed(path, budget)
                magic = _first_bytes(path)
        if magic == _SQLITE_MAGIC:
            return SqliteFile(path, name, budget)
        if magic.startswith(_MCAP_MAGIC):
            return McapFile(path, name, budget)
        if magic.startswith(b'#ROSBAG V'):
            raise BagError(
                f'{name} is a bag of ROS 1, wanted one of ROS 2: convert it with '
                '`rosbags-convert --src FILE --dst FOLDER --dst-storage mcap`'
            )
        seen = f'starts with {magic!r}' if magic else 'is empty'
        raise BagError(f'{name} is not a bag: it {seen}, wanted an MCAP or SQLite recording')

    def _decompressed(self, path: Path, budget: Budget) -> Path:
        """Decompresses a zstd file into a temporary file, which `close` removes."""
        folder = self._scratch.enter_context(tempfile.TemporaryDirectory(prefix='bag_reader.'))
        target = Path(folder) / path.stem
        with path.open('rb') as compressed, target.open('wb') as plain:
            plain.writelines(_decompressed(compressed, budget, sys.maxsize))
        return target


@cache
def _warn_of_cut_off(name: str) -> None:
    """Logs a warning once per file, because a command opens a bag several times."""
    _log.warning(
        '%s breaks off: it is read up to its last complete message; `mcap recover` repairs the '
        'file, and `ros2 bag reindex` the metadata of its folder',
        name,
    )


def _first_bytes(path: Path) -> bytes:
    with path.open('rb') as file:
        return file.read(len(_SQLITE_MAGIC))


def _decompressed(packed: bytes | BinaryIO, budget: Budget, largest: int) -> Iterator[bytes]:
    """Yields the content of zstd frames in pieces, and charges each piece to the budget.

    Args:
        largest: maximum size of the content, bytes.

    Raises:
        BudgetError: the content exceeds `largest` or the budget.
    """
    with zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as stream:
        while piece := stream.read(_PIECE_BYTES):
            budget.spend(unpacked=len(piece))
            largest -= len(piece)
            if largest < 0:
                raise BudgetError('its content is too large')
            yield piece


def _listed(names: Collection[str]) -> str:
    """Formats names for an error message."""
    more = f' and {len(names) - _MAX_NAMES} more' if len(names) > _MAX_NAMES else ''
    return ', '.join(islice(names, _MAX_NAMES)) + more


def _from_its_start(
    file: McapFile | SqliteFile, topics: Collection[str], budget: Budget
) -> Iterator[StoredMessage]:
    """Yields a time mark at the first log time, then opens the file and yields its messages."""
    yield StoredMessage(file.start, None, b'')
    yield from file.messages(topics, budget)


def _full_name(msgtype: str) -> str:
    """Full name of a type; older recorders omitted the middle part, `msg`."""
    package, slash, name = msgtype.partition('/')
    return f'{package}/msg/{name}' if slash and '/' not in name else msgtype
