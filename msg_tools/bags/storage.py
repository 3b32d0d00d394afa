"""The files of a bag: MCAP over the library `mcap`, SQLite over `rosbags`.

A file that its recorder did not complete is read up to its last complete message: a pass of the
stream reader of `mcap` makes the index that is missing. Checksums are compared where the file has
them, and faults are told as the libraries report them.
"""

from __future__ import annotations

import heapq
import io
import os
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple, cast

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import SeekingReader
from mcap.records import Channel as ChannelRecord
from mcap.records import Chunk, ChunkIndex, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from rosbags.interfaces import ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import Reader

from msg_tools.bags.bag_metadata import BagError, reason

_DEFINITIONS = {MessageDefinitionFormat.MSG: 'ros2msg', MessageDefinitionFormat.IDL: 'ros2idl'}
# Bytes of a record before its content, and of a message and a chunk without what varies.
_RECORD, _MESSAGE, _CHUNK = 9, 22, 40


class Channel(NamedTuple):
    """Description of the messages of one topic in a file.

    Attributes:
        topic: as written, with or without a leading slash.
        msgtype: as written; '' if the file does not contain it.
        encoding: 'cdr' for ROS 2.
        definition_encoding: 'ros2msg', 'ros2idl', or '' when there is no definition.
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
def _faults_told(name: str) -> Iterator[None]:
    """Turns what the libraries raise, which do not say what that may be, into BagError."""
    try:
        yield
    except OSError as error:
        raise BagError(f'{name} can not be read: {reason(error)}') from error
    except Exception as error:
        raise BagError(f'{name} is damaged: {type(error).__name__}: {reason(error)}') from error


class SqliteFile:
    """A .db3 file of a bag, the default storage before ROS 2 Iron.

    Attributes:
        name: for messages to the user.
        counts: number of messages of each channel.
        start: log time of the first message, ns; None: there is none.
        cut_off: whether its end is missing.
    """

    cut_off = False

    def __init__(self, path: Path, name: str) -> None:
        self._path, self.name = path, name
        self.counts: Counter[Channel] = Counter()
        with _faults_told(name), Reader(path) as reader:
            self._channels = {
                each.id: Channel(
                    each.topic,
                    each.msgtype,
                    cast(ConnectionExtRosbag2, each.ext).serialization_format,
                    _DEFINITIONS.get(each.msgdef.format, ''),
                    each.msgdef.data,
                )
                for each in reader.connections
            }
            for each in reader.connections:
                self.counts[self._channels[each.id]] += each.msgcount
            self.start = reader.start_time if reader.message_count else None

    def messages(self, topics: Collection[str]) -> Iterator[StoredMessage]:
        """Messages of some topics by log time, then by place in the file.

        Raises:
            BagError: where the file is damaged, after the messages before the damage.
        """
        with _faults_told(self.name), Reader(self._path) as reader:
            wanted = [each for each in reader.connections if each.topic in topics]
            # No connection would mean all of them.
            for connection, time, data in reader.messages(wanted) if wanted else ():
                yield StoredMessage(time, self._channels[connection.id], data)


class McapFile:
    """An MCAP file of a bag; it has what `SqliteFile` has."""

    def __init__(self, path: Path, name: str) -> None:
        self._path, self.name = path, name
        with _faults_told(name), _ExactFile(path) as file:
            self._index = _written_index(file) or _index_of_a_pass(file)
        index = self._index
        self.cut_off = isinstance(index.fault, EndOfFile)
        self.start = index.start
        self._channels = {
            key: _channel(record, index.summary)
            for key, record in sorted(index.summary.channels.items())
        }
        self.counts: Counter[Channel] = Counter()
        for key, channel in self._channels.items():
            self.counts[channel] += index.counts[key]

    def messages(self, topics: Collection[str]) -> Iterator[StoredMessage]:
        """See `SqliteFile.messages`."""
        with _faults_told(self.name), _ExactFile(self._path) as file:
            found = heapq.merge(
                self._bare(file), self._chunked(file, topics), key=attrgetter('log_time')
            )
            for record in found:
                channel = self._channels[record.channel_id]
                if channel.topic in topics:
                    yield StoredMessage(record.log_time, channel, record.data)
            if self._index.fault is not None and not self.cut_off:
                raise self._index.fault

    def _chunked(self, file: BinaryIO, topics: Collection[str]) -> Iterator[Message]:
        summary = self._index.summary
        # Without chunks the library would read the whole file at once.
        if summary.chunk_indexes:
            for _, _, record in _IndexedReader(file, summary).iter_messages(topics):
                yield record

    def _bare(self, file: BinaryIO) -> Iterator[Message]:
        for _, offset, length in sorted(self._index.bare):
            file.seek(offset)
            yield Message.read(ReadDataStream(file), length)


def _channel(record: ChannelRecord, summary: Summary) -> Channel:
    schema = summary.schemas.get(record.schema_id, Schema(0, b'', '', ''))
    definition = schema.data.decode('utf-8', 'replace')
    return Channel(record.topic, schema.name, record.message_encoding, schema.encoding, definition)


class _ExactFile(io.BufferedReader):
    """A file in which a read beyond its end is an error, before memory is spent on it."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        """The next bytes, all of them."""
        if size is not None and size > self._size - self.tell():
            raise EndOfFile(f'{size} bytes are missing after {self._size}')
        return super().read(size)


@dataclass
class _Index:
    """What is in a file, and where.

    Attributes:
        summary: schemas, channels and chunks.
        counts: number of messages of each channel, by its key.
        start: log time of the first message, ns; None: there is none.
        bare: log time, offset and length of the messages outside of chunks.
        fault: what ended the pass over the file; `EndOfFile`: the end is missing.
    """

    summary: Summary
    counts: Counter[int] = field(default_factory=Counter)
    start: int | None = None
    bare: list[tuple[int, int, int]] = field(default_factory=list)
    fault: Exception | None = None

    def add(self, record: McapRecord) -> None:
        """Takes in a record of the data, or of a chunk."""
        if isinstance(record, Schema):
            self.summary.schemas[record.id] = record
        elif isinstance(record, ChannelRecord):
            self.summary.channels[record.id] = record
        elif isinstance(record, Message):
            self.counts[record.channel_id] += 1
            time = record.log_time
            self.start = time if self.start is None else min(self.start, time)

    def add_chunk(self, chunk: Chunk, end: int) -> None:
        """Takes in a chunk that ends at a byte of the file."""
        try:
            records = breakup_chunk(chunk, validate_crc=True)
        except EndOfFile as error:
            raise McapError('a record of a chunk breaks off') from error
        for record in records:
            self.add(record)
        times = [record.log_time for record in records if isinstance(record, Message)]
        length = _RECORD + _CHUNK + len(chunk.compression) + len(chunk.data)
        if times:
            self.summary.chunk_indexes.append(
                ChunkIndex(
                    chunk_length=length,
                    chunk_start_offset=end - length,
                    compression=chunk.compression,
                    compressed_size=len(chunk.data),
                    message_end_time=max(times),
                    message_index_length=0,
                    message_index_offsets={},
                    message_start_time=min(times),
                    uncompressed_size=chunk.uncompressed_size,
                )
            )


class _IndexedReader(SeekingReader):
    """Reads a file by an index that may be made by a pass over it."""

    def __init__(self, file: BinaryIO, index: Summary) -> None:
        super().__init__(file, validate_crcs=True)
        self._index = index

    def get_summary(self) -> Summary:
        """The index."""
        return self._index


def _written_index(file: BinaryIO) -> _Index | None:
    """The index at the end of a file; None: there is none, or not of all chunks."""
    try:
        summary = SeekingReader(file).get_summary()
    except Exception:  # noqa: BLE001 - a pass over the file tells what is wrong
        return None
    if summary is None or (statistics := summary.statistics) is None:
        return None
    counts = Counter(statistics.channel_message_counts)
    described = [summary.channels.get(key) for key in counts]
    schemas = {0, *summary.schemas}
    if (
        counts.total() != statistics.message_count
        or len(summary.chunk_indexes) != statistics.chunk_count
        or (statistics.message_count and not summary.chunk_indexes)
        or any(each is None or each.schema_id not in schemas for each in described)
    ):
        return None
    start = statistics.message_start_time if statistics.message_count else None
    return _Index(summary, counts, start)


def _index_of_a_pass(file: BinaryIO) -> _Index:
    """The index of a file up to its end, or to where it breaks off or is damaged."""
    index = _Index(Summary())
    file.seek(0)
    try:
        for record in StreamReader(file, emit_chunks=True, validate_crcs=True).records:
            index.add(record)
            if isinstance(record, Chunk):
                index.add_chunk(record, file.tell())
            elif isinstance(record, Message):
                length = _MESSAGE + len(record.data)
                index.bare.append((record.log_time, file.tell() - length, length))
    except Exception as error:  # noqa: BLE001 - told behind the messages before it
        index.fault = error
    return index
