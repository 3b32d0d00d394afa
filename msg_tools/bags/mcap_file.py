"""Reads an MCAP file of a bag.

An incomplete file is read up to its last complete message; a pass over the file builds the missing
index. Checksums of chunks are verified if the file has them. Lengths are compared with the size of
the file and charged to a budget before memory is allocated; attachments are not read.

Format: https://mcap.dev/spec
"""

from __future__ import annotations

import heapq
import os
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from operator import attrgetter
from pathlib import Path
from typing import Any, BinaryIO

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Channel as ChannelRecord
from mcap.records import ChunkIndex, Schema, Statistics
from mcap.stream_reader import StreamReader

from msg_tools.bags.storage import MAX_CHUNK_BYTES, NEVER_NS, Channel, StoredMessage, as_bag_errors
from msg_tools.files.budget import Budget, BudgetError

MAGIC = b'\x89MCAP0\r\n'

# Layouts of the header of a record (opcode, length), and of the needed fields of some records.
_RECORD = struct.Struct('<BQ')
_MESSAGE = struct.Struct('<HIQQ')
_CHUNK = struct.Struct('<16xQI')
_FOOTER = struct.Struct('<B8xQ12x8s')
_DESCRIPTIONS: dict[int, Any] = {Opcode.SCHEMA: Schema, Opcode.CHANNEL: ChannelRecord}

# Maximum sizes, bytes: a summary; a schema or channel; a run of records outside of chunks; all open
# chunks. Then the memory per byte of a schema or channel, bytes.
_MAX_SUMMARY, _MAX_DESCRIPTION, _MAX_RUN, _MAX_OPEN = 2**25, 2**20, 2**20, 2**28 + 2**27
_MEMORY_PER_BYTE = 16
_RECORDS_PER_SKIPPED = 8  # cost of a skipped record in the budget, in records


@dataclass
class _Index:
    """The index of a file.

    Attributes:
        schemas: schemas by key.
        channels: channels by key.
        chunks: chunks, and runs of records outside of chunks, in the order of the file.
        counts: number of messages by channel key.
        fault: exception that ended the pass over the file; `EndOfFile` if the end is missing.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, ChannelRecord] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    fault: Exception | None = None

    def add(self, file: _File, offset: int, end: int, *, bare: bool) -> None:
        """Adds the chunk, or the records outside of chunks, between two file offsets."""
        counts: Counter[int] = Counter()
        start, whole = NEVER_NS, 0
        data = file.content(offset, end)
        try:
            for opcode, place, stop in file.records(data):
                if opcode == Opcode.MESSAGE:
                    key, _, time, _ = _MESSAGE.unpack_from(data, place)
                    counts[key] += 1
                    start = min(start, time)
                elif opcode in _DESCRIPTIONS:
                    file.budget.spend(unpacked=_MEMORY_PER_BYTE * (stop - place))
                    if stop - place > _MAX_DESCRIPTION:
                        raise McapError(f'a schema or channel of {stop - place} bytes')
                    kind = _DESCRIPTIONS[opcode]
                    self.describe(kind.read(ReadDataStream(BytesIO(data[place:stop]))))
                whole = stop
        except EndOfFile as error:
            raise McapError('a record breaks off') from error
        finally:
            # Records outside of chunks that precede a fault are kept.
            if counts and (bare or whole == len(data)):
                length = whole if bare else end - offset
                self.chunks.append(ChunkIndex(length, offset, '', 0, 0, 0, {}, start, 0))
                self.counts.update(counts)

    def describe(self, record: object) -> None:
        """Adds a schema or a channel."""
        if isinstance(record, Schema):
            self.schemas[record.id] = record
        elif isinstance(record, ChannelRecord):
            self.channels[record.id] = record


class McapFile:
    """A file in the MCAP format.

    Args:
        name: name of the file in messages to the user.
        budget: budget for opening the bag.

    Attributes:
        counts: number of messages of each channel.
        start: lower bound of the log time of the first message, ns; `NEVER_NS` if it has no
            messages.
        cut_off: whether the end of the file is missing.
    """

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        self._path, self.name = path, name
        with as_bag_errors(name), path.open('rb') as opened:
            file = _File(opened, budget)
            index = None
            with suppress(Exception):  # the pass over the file, below, finds the fault
                index = _written_index(file)
            self._index = index or _index_of_a_pass(file)
        index = self._index
        self.cut_off = isinstance(index.fault, EndOfFile)
        self.start = min((x.message_start_time for x in index.chunks), default=NEVER_NS)
        definitions = {
            key: each.data.decode('utf-8', 'replace') for key, each in index.schemas.items()
        }
        self._channels: dict[int, Channel] = {}
        self.counts: Counter[Channel] = Counter()
        for key, each in sorted(index.channels.items()):
            schema = index.schemas.get(each.schema_id, Schema(0, b'', '', ''))
            definition = definitions.get(each.schema_id, '')
            channel = Channel(
                each.topic, schema.name, each.message_encoding, schema.encoding, definition
            )
            self._channels[key] = channel
            self.counts[channel] += index.counts[key]

    def messages(self, topics: Collection[str], budget: Budget) -> Iterator[StoredMessage]:
        """Yields messages on the topics, and time marks, sorted by log time and file offset.

        Args:
            budget: budget for one pass over the bag.

        Raises:
            BagError: the file is damaged (raised after the intact messages), or exceeds the budget.
        """
        wanted = {key for key, channel in self._channels.items() if channel.topic in topics}
        with as_bag_errors(self.name), self._path.open('rb') as opened:
            file = _File(opened, budget)
            chunks = [
                file.messages(chunk, self._channels, wanted)
                for chunk in self._index.chunks
                if not chunk.message_index_offsets
                or not wanted.isdisjoint(chunk.message_index_offsets)
            ]
            yield from heapq.merge(*chunks, key=attrgetter('log_time'))
            if self._index.fault is not None and not self.cut_off:
                raise self._index.fault


class _File:
    """An open file; one pass over it is charged to a budget.

    Attributes:
        size: size of the file, bytes.
        budget: budget of the pass.
    """

    def __init__(self, file: BinaryIO, budget: Budget) -> None:
        self._file, self.budget = file, budget
        self.size = os.fstat(file.fileno()).st_size
        self._open = 0  # size of all open chunks, bytes

    def read(self, offset: int, end: int) -> bytes:
        """Reads the bytes between two offsets; raises EndOfFile if some are missing."""
        if end > self.size:
            raise EndOfFile(f'{end - self.size} bytes are missing after {self.size}')
        self._file.seek(offset)
        return self._file.read(end - offset)

    def records(self, data: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
        """Yields the opcode of each record, and the start and end of its content."""
        end, opcode, length = 0, 0, 0
        while end < len(data):
            self.budget.spend(records=1)
            start = end + _RECORD.size
            if start <= len(data):
                opcode, length = _RECORD.unpack_from(data, end)
            end = start + length
            if end > len(data) or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
                raise McapError('a record of a chunk breaks off')
            yield opcode, start, end

    def content(self, offset: int, end: int) -> bytes | memoryview:
        """Decompressed chunk, or records outside of chunks, read between two file offsets."""
        if end - offset > MAX_CHUNK_BYTES + _MAX_RUN:
            raise McapError(f'a record of {end - offset} bytes')
        record = memoryview(self.read(offset, end))
        if record[0] != Opcode.CHUNK:
            return record
        size, checksum = _CHUNK.unpack_from(record, _RECORD.size)
        at = _RECORD.size + _CHUNK.size
        (length,) = struct.unpack_from('<I', record, at)
        compression = bytes(record[at + 4 : at + 4 + length])
        (length,) = struct.unpack_from('<Q', record, at + 4 + len(compression))
        packed = record[at + 12 + len(compression) :][:length]
        if len(packed) < length or size > MAX_CHUNK_BYTES:
            raise McapError(f'a chunk of {length} bytes for {size}')
        if not compression:
            data: bytes | memoryview = packed
        else:
            self.budget.spend(unpacked=size)
            data = _unpacked(packed, compression, size)
        if checksum and zlib.crc32(data) != checksum:
            raise McapError('a chunk has another checksum')
        return data

    def messages(
        self, chunk: ChunkIndex, channels: Mapping[int, Channel], wanted: Collection[int]
    ) -> Iterator[StoredMessage]:
        """Yields a time mark at the start of a chunk, then reads it and yields its messages."""
        yield StoredMessage(chunk.message_start_time, None, b'')
        start = chunk.chunk_start_offset
        data = self.content(start, start + chunk.chunk_length)
        self._open += len(data)
        if self._open > _MAX_OPEN:
            raise BudgetError(f'its chunks overlap in time, by more than {_MAX_OPEN} bytes')
        times, starts, fault = array('Q'), array('Q'), None
        for opcode, start, _ in self.records(data):
            if opcode == Opcode.MESSAGE:
                key, _, time, _ = _MESSAGE.unpack_from(data, start)
                if key in wanted:
                    times.append(time)
                    starts.append(start)
                elif key not in channels:
                    fault = McapError(f'a message of channel {key}, which is not described')
        for i in np.argsort(np.asarray(times), kind='stable'):
            start = starts[i]
            key, _, time, _ = _MESSAGE.unpack_from(data, start)
            _, length = _RECORD.unpack_from(data, start - _RECORD.size)
            content = bytes(data[start + _MESSAGE.size : start + length])
            yield StoredMessage(time, channels[key], content)
        self._open -= len(data)
        if fault is not None:
            raise fault


def _unpacked(packed: memoryview, compression: bytes, size: int) -> bytes:
    """Decompresses a chunk; allocates no memory beyond the given size."""
    whole = True
    if compression == b'zstd':
        known = zstandard.get_frame_parameters(packed).content_size
        whole = known in (size, zstandard.CONTENTSIZE_UNKNOWN)
        data = zstandard.ZstdDecompressor().decompress(packed, size) if whole else b''
    elif compression == b'lz4':
        decompressor = lz4.frame.LZ4FrameDecompressor()
        data = decompressor.decompress(packed, max_length=size)
        whole = decompressor.eof
    else:
        raise McapError(f'the compression {compression[:20]!r}, wanted zstd or lz4')
    if not whole or len(data) != size:
        raise McapError(f'a chunk of another size than {size}')
    return data


def _written_index(file: _File) -> _Index | None:
    """The index at the end of a file; None if it is missing or incomplete."""
    end = file.size - _FOOTER.size
    opcode, summary, magic = _FOOTER.unpack(file.read(end, file.size))
    if opcode != Opcode.FOOTER or magic != MAGIC or not 0 < summary < end <= summary + _MAX_SUMMARY:
        return None
    index, statistics, place = _Index(), None, len(MAGIC)
    data = BytesIO(file.read(summary, file.size))
    for record in StreamReader(data, skip_magic=True, emit_chunks=True).records:
        file.budget.spend(records=1)
        index.describe(record)
        if isinstance(record, Statistics):
            statistics = record
        elif isinstance(record, ChunkIndex):
            index.chunks.append(record)
            if record.chunk_start_offset < place:
                return None  # the index lists a chunk twice
            place = record.chunk_start_offset + record.chunk_length
    if statistics is None or place > summary:
        return None
    index.counts.update(statistics.channel_message_counts)
    whole = (
        sum(index.counts.values()) == statistics.message_count
        and len(index.chunks) == statistics.chunk_count
        and (index.chunks or not statistics.message_count)
        and index.channels.keys() >= index.counts.keys()
        and {0, *index.schemas} >= {index.channels[key].schema_id for key in index.counts}
    )
    return index if whole else None


def _index_of_a_pass(file: _File) -> _Index:
    """Builds the index by reading the file up to its end, or to the first damaged byte."""
    index = _Index()
    try:
        for start, end, bare in _pieces(file):
            index.add(file, start, end, bare=bare)
    except BudgetError:
        raise
    except Exception as error:  # noqa: BLE001 - raised after the messages before it
        index.fault = error
    return index


def _pieces(file: _File) -> Iterator[tuple[int, int, bool]]:
    """Yields (start, end, bare) of chunks, and of runs of records outside of chunks (bare)."""
    run = at = len(MAGIC)
    opcode = 0
    try:
        while opcode != Opcode.FOOTER:
            opcode, length = _RECORD.unpack(file.read(at, at + _RECORD.size))
            end = at + _RECORD.size + length
            if end > file.size:
                raise EndOfFile(f'{end - file.size} bytes are missing after {file.size}')
            bare = opcode == Opcode.MESSAGE or opcode in _DESCRIPTIONS
            file.budget.spend(records=0 if bare else _RECORDS_PER_SKIPPED)
            if run < at and (not bare or end - run > _MAX_RUN):
                yield run, at, True
                run = at
            if opcode == Opcode.CHUNK:
                yield at, end, False
            at = end
            if not bare:
                run = at
        if file.read(at, at + len(MAGIC)) != MAGIC:
            raise McapError('another end than that of an MCAP file')
    except EndOfFile:
        if run < at:
            yield run, at, True
        raise
