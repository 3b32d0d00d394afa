"""Reads a bag: a folder of rosbag2, or a single .mcap or .db3 file, also compressed with zstd.

Messages come in the order of their log times; messages of equal times come in the order of the
files. Memory holds the chunks of the present time, never a whole file. Every fault of a bag is a
`BagError` of one line.

    with BagReader('walk') as bag:
        topic = bag.find_topic(['sensor_msgs/msg/CompressedImage'])
        for stored in bag.messages([topic.name]):
            print(stored.log_time_ns, stored.message.format)
"""

from __future__ import annotations

import os
import sqlite3
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rosbags.typesys.store import Typestore

from msg_tools.bags.bag_metadata import read_file_names
from msg_tools.bags.contents import BagError, Channel, Source, StoredMessage, merge, reason
from msg_tools.bags.mcap_file import McapFile
from msg_tools.bags.mcap_records import (
    ZSTD_MAGIC,
    DecompressionError,
    decompress_file,
    decompress_zstd,
)
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.message_types import RosbagsMessages, typestore_of_definition

_SQLITE_MAGIC = b'SQLite format 3\x00'


_NEVER = 2**64  # later than any log time
_OURS = 'hmt_msgs/'


class SqliteFile:
    """A .db3 file, the default storage before ROS 2 Iron.

    The counterpart of `McapFile`, with the same attributes.
    """

    def __init__(self, path: Path, name: str) -> None:
        self._path = path
        self._name = name
        self.damage: str | None = None
        self.counts: dict[Channel, int] = {}
        self._channels: dict[int, Channel] = {}
        try:
            with closing(self._connect()) as database:
                counts = dict(
                    database.execute('SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id')
                )
                definitions = self._definitions(database)
                for key, topic, msgtype, encoding in database.execute(
                    'SELECT id, name, type, serialization_format FROM topics ORDER BY id'
                ):
                    definition = definitions.get(msgtype, ('', b''))
                    channel = Channel(str(topic), str(msgtype), str(encoding), *definition)
                    self._channels[key] = channel
                    self.counts[channel] = self.counts.get(channel, 0) + counts.get(key, 0)
                self.start, self.end = database.execute(
                    'SELECT MIN(timestamp), MAX(timestamp) FROM messages'
                ).fetchone()
        except sqlite3.Error as error:
            raise BagError(f'{name} is not a bag of rosbag2: {reason(error)}') from error
        if not all(isinstance(time, int | None) for time in (self.start, self.end)):
            raise BagError(f'{name} is damaged: a time is not a whole number')

    def _connect(self) -> sqlite3.Connection:
        return sqlite3.connect(f'file:{quote(str(self._path.resolve()))}?mode=ro', uri=True)

    @staticmethod
    def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, bytes]]:
        # Bags of ROS 2 Humble and before do not carry them.
        table = "SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'"
        if database.execute(table).fetchone() is None:
            return {}
        rows = database.execute(
            'SELECT topic_type, encoding, encoded_message_definition FROM message_definitions'
        )
        return {name: (str(encoding), str(text).encode()) for name, encoding, text in rows}

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda channel: True
    ) -> Iterator[tuple[int, StoredMessage]]:
        """Log time in ns and message, by log time, then in the order in which they were written.

        Raises:
            BagError: where the file is damaged, after the messages before the damage.
        """
        keys = [key for key, channel in self._channels.items() if wanted(channel)]
        query = (
            'SELECT topic_id, timestamp, data FROM messages '
            f'WHERE topic_id IN ({", ".join("?" * len(keys))}) ORDER BY timestamp, id'
        )
        try:
            with closing(self._connect()) as database:
                for key, time, data in database.execute(query, keys):
                    if not isinstance(time, int) or not isinstance(data, bytes):
                        raise BagError(
                            f'{self._name} is damaged: a message at {time!r} has no data'
                        )
                    yield time, StoredMessage(self._channels[key], memoryview(data))
        except sqlite3.Error as error:
            raise BagError(f'{self._name} is damaged: {reason(error)}') from error


@dataclass(frozen=True)
class Topic:
    """A topic of a bag.

    Attributes:
        name: as written in the bag, with or without a leading slash.
        msgtype: for example 'sensor_msgs/msg/Image'; '' if the bag does not contain it.
        encoding: of the messages; 'cdr' for ROS 2.
        message_count: how many there are, by the statistics of the bag.
    """

    name: str
    msgtype: str
    encoding: str
    message_count: int


@dataclass(frozen=True)
class BagMessage:
    """A message of a bag, still as bytes until `message` is asked for.

    Attributes:
        topic: as written in the bag.
        msgtype: for example 'sensor_msgs/msg/Image'.
        log_time_ns: when it was recorded.
        data: CDR bytes, as stored.
    """

    topic: str
    msgtype: str
    log_time_ns: int
    data: memoryview = field(repr=False)
    _deserialise: Callable[[BagMessage], Any] = field(repr=False)

    @cached_property
    def message(self) -> Any:
        """The message, with the fields of its type; arrays are read-only.

        One of hmt_msgs that was recorded with an older definition has today's fields; the new ones
        are zero or empty.

        Raises:
            BagError: its bytes do not fit its type, or the type is not known.
        """
        return self._deserialise(self)

    def with_message(self, message: Any) -> BagMessage:
        """Another message of `rosbags` in the place of this one; it has no bytes."""
        kind = message.__msgtype__
        return BagMessage(self.topic, kind, self.log_time_ns, memoryview(b''), lambda _: message)


class BagReader(AbstractContextManager['BagReader']):
    """A bag that is open for reading.

    Args:
        path: folder with metadata.yaml, or a file.

    Raises:
        BagError: not a bag, or nothing of it can be read.

    Attributes:
        path: as given.
        topics: by name, in the order of the bag.
        start_ns, end_ns: log times of the first and the last message; None when there is none.
        damage: damage that is already known, None when there is none; it is raised by `messages`
            once everything before it is out.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._typestores: dict[Channel, Typestore] = {}
        self._scratch: tempfile.TemporaryDirectory[str] | None = None
        try:
            self._files = [self._open_file(file) for file in self._storage_paths()]
        except BaseException:
            self.close()
            raise
        self.topics: dict[str, Topic] = {}
        for file in self._files:
            for channel, count in file.counts.items():
                known = self.topics.get(channel.topic)
                self.topics[channel.topic] = Topic(
                    channel.topic,
                    known.msgtype if known else _full_name(channel.msgtype),
                    known.encoding if known else channel.encoding,
                    count + (known.message_count if known else 0),
                )
        self.start_ns = min((f.start for f in self._files if f.start is not None), default=None)
        self.end_ns = max((f.end for f in self._files if f.end is not None), default=None)
        self.damage = next((f.damage for f in self._files if f.damage is not None), None)

    def close(self) -> None:
        """Removes the files that were decompressed into the folder for temporary files."""
        if self._scratch is not None:
            self._scratch.cleanup()
            self._scratch = None

    def __exit__(self, *_: object) -> None:
        self.close()

    def raise_damage(self) -> None:
        """Raises BagError if damage is already known."""
        if self.damage is not None:
            raise BagError(f'{self.path} {self.damage}')

    def message_count(self, topics: Iterable[str] | None = None) -> int:
        """Number of messages of some topics, or of all.

        Raises:
            BagError: no such topic.
        """
        names = self.topics if topics is None else {self.topic(name).name for name in topics}
        return sum(self.topics[name].message_count for name in names)

    def topic(self, name: str) -> Topic:
        """The topic of a name, with or without its leading slash.

        A relative name that is not there means the topic of that name in a namespace, if only one
        namespace has it.

        Raises:
            BagError: there is none, or several namespaces have it.
        """
        for candidate in (name, f'/{name}', name.removeprefix('/')):
            if candidate in self.topics:
                return self.topics[candidate]
        inside = [x for x in self.topics if not name.startswith('/') and x.endswith(f'/{name}')]
        if len(inside) == 1:
            return self.topics[inside[0]]
        if inside:
            raise BagError(
                f'{self.path} has several topics {name}: name one of {", ".join(inside)}'
            )
        self.raise_damage()
        raise BagError(f'{self.path} has no topic {name}; it has {self._topic_names()}')

    def find_topic(self, msgtypes: Iterable[str], name: str | None = None) -> Topic:
        """The one topic of some types.

        Args:
            msgtypes: types that will do.
            name: of the topic, where several have such a type; None when there is only one.

        Raises:
            BagError: no topic, several topics, another type, no message.
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
            used = [topic for topic in found if topic.message_count]
            if len(used) > 1:
                names = ', '.join(topic.name for topic in used)
                raise BagError(f'{self.path} has several topics of {short}: name one of {names}')
            if not found:
                self.raise_damage()
                raise BagError(
                    f'{self.path} has no topic of type {short}; it has {self._topic_names()}'
                )
            topic = (used or found)[0]
        if not topic.message_count:
            self.raise_damage()
            raise BagError(f'{self.path}: topic {topic.name} has no messages')
        return topic

    def messages(self, topics: Iterable[str] | None = None) -> Iterator[BagMessage]:
        """Messages by log time, then by place in the bag.

        Args:
            topics: names, with or without leading slash; None for all.

        Raises:
            BagError: no such topic, a topic that is not CDR or of two types; where the bag is
                damaged, after the messages before the damage.
        """
        if topics is None:
            return self._merged(lambda channel: True)
        names = {self.topic(name).name for name in topics}
        for name in names:
            channels = {
                (_full_name(channel.msgtype), channel.encoding)
                for file in self._files
                for channel in file.counts
                if channel.topic == name
            }
            if len(channels) > 1:
                kinds = ' and '.join(sorted(' as '.join(kind) for kind in channels))
                raise BagError(f'{self.path}: topic {name} has messages of several kinds: {kinds}')
            self._check_encoding(name, self.topics[name].encoding)
        return self._merged(lambda channel: channel.topic in names)

    def _merged(self, wanted: Callable[[Channel], bool]) -> Iterator[BagMessage]:
        sources = [
            # A file without messages comes last: all it can do is to report its damage.
            Source(
                _NEVER if file.start is None else file.start, order, partial(file.messages, wanted)
            )
            for order, file in enumerate(self._files)
        ]
        for time, stored in merge(sources):
            yield self._bag_message(time, stored)

    def _bag_message(self, time: int, stored: StoredMessage) -> BagMessage:
        channel = stored.channel
        return BagMessage(
            channel.topic,
            _full_name(channel.msgtype),
            time,
            stored.data,
            partial(self._deserialise, channel),
        )

    def _deserialise(self, channel: Channel, stored: BagMessage) -> Any:
        self._check_encoding(stored.topic, channel.encoding)
        what = f'{self.path}: message of {stored.topic} at {stored.log_time_ns} ns'
        data = stored.data
        try:
            store = self._typestores.get(channel)
            if store is None:
                store = self._typestores[channel] = typestore_of_definition(
                    stored.msgtype,
                    channel.definition_encoding,
                    channel.definition.decode('utf-8', 'replace'),
                )
            # Bags with the compression mode "message". No CDR message starts like this.
            if data[:4] == ZSTD_MAGIC:
                data = memoryview(decompress_zstd(data))
            message = deserialise(data, stored.msgtype, store)
            return self._adopted(message) if stored.msgtype.startswith(_OURS) else message
        except Exception as error:
            # Bytes from outside meet generated code here, which does not say what it may raise.
            raise BagError(
                f'{what} can not be read as {stored.msgtype or "unknown type"}: {reason(error)}'
            ) from error

    def _adopted(self, message: Any) -> Any:
        """A message of this project with all fields it has today; as it is if that can not be."""
        try:
            return RosbagsMessages().adopt(message)
        except TypeError:
            return message

    def _check_encoding(self, topic: str, encoding: str) -> None:
        if encoding != 'cdr':
            raise BagError(
                f'{self.path}: messages of {topic} are encoded as {encoding!r}, wanted cdr as '
                'ROS 2 records it'
            )

    def _topic_names(self) -> str:
        return ', '.join(self.topics) or 'none'

    # Files

    def _storage_paths(self) -> list[Path]:
        try:
            mode = self.path.stat().st_mode
        except (OSError, ValueError) as error:
            raise BagError(f'{self.path} can not be read: {reason(error)}') from error
        if stat.S_ISREG(mode):
            return [self.path]
        if not stat.S_ISDIR(mode):
            raise BagError(f'{self.path} is neither a file nor a folder')
        paths = [self.path / name for name in read_file_names(self.path)]
        for path in paths:
            if not path.is_file():
                raise BagError(
                    f'{self.path}: the file {path.name}, which its metadata names, is missing'
                )
        return paths

    def _open_file(self, path: Path) -> McapFile | SqliteFile:
        name = str(path)
        try:
            with path.open('rb') as file:
                magic = file.read(16)
            if magic.startswith(ZSTD_MAGIC):
                path = self._decompressed(path)
                with path.open('rb') as file:
                    magic = file.read(16)
        except OSError as error:
            raise BagError(f'{name} can not be read: {reason(error)}') from error
        except DecompressionError as error:
            raise BagError(f'{name} is damaged: {error}') from error
        if magic == _SQLITE_MAGIC:
            return SqliteFile(path, name)
        if magic.startswith(b'#ROSBAG V'):
            raise BagError(
                f'{name} is a bag of ROS 1, wanted one of ROS 2: convert it with '
                '`rosbags-convert --src FILE --dst FOLDER --dst-storage mcap`'
            )
        return McapFile(path, name)

    def _decompressed(self, path: Path) -> Path:
        """The content of a zstd file, as a file that lives as long as the reader."""
        if self._scratch is None:
            self._scratch = tempfile.TemporaryDirectory(prefix='bag_reader.')
        folder = Path(self._scratch.name)
        target = folder / str(sum(1 for _ in folder.iterdir()))
        with path.open('rb') as compressed, target.open('wb') as plain:
            for piece in decompress_file(compressed):
                plain.write(piece)
        return target


def _full_name(msgtype: str) -> str:
    """Name of a type with its middle part, which older recorders left out."""
    package, slash, name = msgtype.partition('/')
    return f'{package}/msg/{name}' if slash and '/' not in name else msgtype
