"""An MCAP file of a bag.

A file that its recorder did not complete is read up to its last complete message: a pass over it
makes the index that is missing. Checksums are compared where the file has them. Lengths are
compared with what is there, and spent from a budget, before memory is; attachments are not read.

The format: https://mcap.dev/spec
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
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode

from msg_tools.bags.storage import LARGEST, MAX_TOPICS, NEVER, Channel, StoredMessage, faults_told
from msg_tools.files.budget import Budget

MAGIC = b'\x89MCAP0\r\n'

# Opcode and length, which stand before every record; the records, as far as their sizes are fixed.
_RECORD = struct.Struct('<BQ')
_MESSAGE = struct.Struct('<HIQQ')
_CHUNK = struct.Struct('<16xQI')
_CHUNK_INDEX = struct.Struct('<Q8xQQI')
_STATISTICS = struct.Struct('<Q14xIQ8xI')
_FOOTER = struct.Struct('<B8xQ12x8s')
_BY_CHANNEL = np.dtype([('channel', '<u2'), ('value', '<u8')])

# Bytes of a summary, of all schemas and channels, and of the chunks that are open at a time.
_MAX_SUMMARY, _MAX_DESCRIPTION, _MAX_OPEN = 2**26, 2**25, 2**28 + 2**27
_PIECE = 2**20


class _Chunk(NamedTuple):
    """Where a chunk is, the log time of its first message, and its channels, if they are known."""

    offset: int
    start: int
    channels: bytes = b''


@dataclass
class _Index:
    """What is in a file, and where.

    Attributes:
        schemas: name, encoding and text of the schemas, by their keys.
        channels: key of the schema, topic and encoding of the channels, by their keys.
        chunks: in the order of the file.
        counts: number of messages of each channel, by its key.
        start: log time of the first message, ns; `NEVER`: there is none.
        times: log times of the messages outside of chunks.
        offsets: of their records.
        fault: what ended the pass over the file; `EndOfFile`: the end is missing.
    """

    schemas: dict[int, tuple[str, str, str]] = field(default_factory=dict)
    channels: dict[int, tuple[int, str, str]] = field(default_factory=dict)
    chunks: list[_Chunk] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    start: int = NEVER
    times: array[int] = field(default_factory=partial(array, 'Q'))
    offsets: array[int] = field(default_factory=partial(array, 'Q'))
    fault: Exception | None = None
    _lengths: dict[tuple[int, int], int] = field(default_factory=dict)  # of schemas and channels
    _description: int = 0  # bytes of them all

    def describe(self, opcode: int, record: bytes) -> None:
        """Takes in a schema or a channel."""
        key = opcode, _number(record, 0)
        self._description += len(record) - self._lengths.get(key, 0)
        self._lengths[key] = len(record)
        if self._description > _MAX_DESCRIPTION:
            raise ValueError(f'its schemas and channels take more than {_MAX_DESCRIPTION} bytes')
        if opcode == Opcode.SCHEMA:
            name, at = _text(record, 2)
            encoding, at = _text(record, at)
            self.schemas[key[1]] = name, encoding, _text(record, at)[0]
        else:
            topic, at = _text(record, 4)
            self.channels[key[1]] = _number(record, 2), topic, _text(record, at)[0]

    def add_chunk(self, offset: int, reading: _Reading) -> None:
        """Takes in the chunk at a place of the file."""
        data = reading.chunk(offset)
        counts: Counter[int] = Counter()
        first = NEVER
        for opcode, start, end in reading.records(data):
            if opcode == Opcode.MESSAGE:
                key, _, time, _ = _MESSAGE.unpack_from(data, start)
                counts[key] += 1
                first = min(first, time)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.describe(opcode, bytes(data[start:end]))
        if counts:
            self.chunks.append(_Chunk(offset, first))
            self.counts.update(counts)
            self.start = min(self.start, first)

    def described(self) -> dict[int, Channel]:
        """The channels by their keys."""
        return {
            key: Channel(topic, name, encoding, *definition)
            for key, (schema, topic, encoding) in sorted(self.channels.items())
            for name, *definition in [self.schemas.get(schema, ('', '', ''))]
        }


class McapFile:
    """A file in the format MCAP; see `BagFile`.

    Args:
        budget: of opening the bag.
    """

    def __init__(self, path: Path, name: str, budget: Budget) -> None:
        self._path, self.name = path, name
        with faults_told(name), path.open('rb') as file:
            reading = _Reading(file, budget)
            self._index = _written_index(reading) or _index_of_a_pass(reading)
        self.cut_off = isinstance(self._index.fault, EndOfFile)
        self.start = self._index.start
        self._channels = self._index.described()
        self.counts: Counter[Channel] = Counter()
        for key, channel in self._channels.items():
            self.counts[channel] += self._index.counts[key]

    def messages(self, topics: Collection[str], budget: Budget) -> Iterator[StoredMessage]:
        """See `BagFile.messages`."""
        wanted = {key for key, channel in self._channels.items() if channel.topic in topics}
        with faults_told(self.name), self._path.open('rb') as file:
            reading = _Reading(file, budget)
            chunks = [
                reading.messages(chunk, self._channels, wanted)
                for chunk in self._index.chunks
                if not chunk.channels
                or not wanted.isdisjoint(
                    np.frombuffer(chunk.channels, _BY_CHANNEL)['channel'].tolist()
                )
            ]
            bare = reading.bare_messages(self._index, self._channels, wanted)
            yield from heapq.merge(bare, *chunks, key=attrgetter('log_time'))
            if self._index.fault is not None and not self.cut_off:
                raise self._index.fault


class _Reading:
    """A pass over a file, which spends a budget.

    Attributes:
        size: of the file, bytes.
    """

    def __init__(self, file: BinaryIO, budget: Budget) -> None:
        self._file, self._budget = file, budget
        self.size = os.fstat(file.fileno()).st_size
        self._open = 0  # bytes of the chunks that are open

    def read(self, offset: int, length: int) -> bytes:
        """Bytes of the file, all of them."""
        if length > self.size - offset:
            raise EndOfFile(f'{length} bytes are missing after {self.size}')
        self._file.seek(offset)
        return self._file.read(length)

    def record(self, offset: int) -> tuple[int, int]:
        """Opcode and length of a record of the file."""
        opcode, length = _RECORD.unpack(self.read(offset, _RECORD.size))
        if length > self.size - offset - _RECORD.size:
            raise EndOfFile(f'{length} bytes are missing after {self.size}')
        return opcode, length

    def records(self, data: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
        """Opcodes, starts and ends of the records in a chunk or in a summary."""
        end = 0
        while end < len(data):
            self._budget.spend(records=1)
            start = end + _RECORD.size
            if start > len(data):
                raise McapError('a record of a chunk breaks off')
            opcode, length = _RECORD.unpack_from(data, end)
            end = start + length
            if end > len(data) or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
                raise McapError('a record of a chunk breaks off')
            yield opcode, start, end

    def chunk(self, offset: int) -> bytes | memoryview:
        """Content of a chunk."""
        opcode, length = self.record(offset)
        if opcode != Opcode.CHUNK or length > LARGEST + _PIECE:
            raise McapError(f'no chunk of at most {LARGEST} bytes at {offset}')
        record = memoryview(self.read(offset + _RECORD.size, length))
        size, checksum = _CHUNK.unpack_from(record)
        compression, at = _text(record, _CHUNK.size)
        (length,) = struct.unpack_from('<Q', record, at)
        packed = record[at + 8 : at + 8 + length]
        if len(packed) < length or size > LARGEST:
            raise McapError(f'a chunk of {length} bytes for {size}')
        if compression:
            self._budget.spend(unpacked=size)
        data = _unpacked(packed, compression, size)
        if checksum and zlib.crc32(data) != checksum:
            raise McapError('a chunk has another checksum')
        return data

    def messages(
        self, chunk: _Chunk, channels: Mapping[int, Channel], wanted: Collection[int]
    ) -> Iterator[StoredMessage]:
        """A mark, then the messages of a chunk: it is not opened before its time has come."""
        yield StoredMessage(chunk.start, None, b'')
        data = self.chunk(chunk.offset)
        self._open += len(data)
        if self._open > _MAX_OPEN:
            raise ValueError(f'its chunks overlap in time, by more than {_MAX_OPEN} bytes')
        times, starts = array('Q'), array('Q')
        for opcode, start, _ in self.records(data):
            if opcode == Opcode.MESSAGE:
                key, _, time, _ = _MESSAGE.unpack_from(data, start)
                if key in wanted:
                    times.append(time)
                    starts.append(start)
                elif key not in channels:
                    raise McapError(f'a message of channel {key}, which is not described')
        for i in np.argsort(np.asarray(times), kind='stable'):
            start = starts[i]
            key, _, time, _ = _MESSAGE.unpack_from(data, start)
            end = start + _RECORD.unpack_from(data, start - _RECORD.size)[1]
            yield StoredMessage(time, channels[key], bytes(data[start + _MESSAGE.size : end]))
        self._open -= len(data)

    def bare_messages(
        self, index: _Index, channels: Mapping[int, Channel], wanted: Collection[int]
    ) -> Iterator[StoredMessage]:
        """The messages outside of chunks."""
        for i in np.argsort(np.asarray(index.times), kind='stable'):
            start = index.offsets[i] + _RECORD.size
            _, length = self.record(index.offsets[i])
            key, _, time, _ = _MESSAGE.unpack(self.read(start, _MESSAGE.size))
            if key in wanted:
                data = self.read(start + _MESSAGE.size, length - _MESSAGE.size)
                yield StoredMessage(time, channels[key], data)
            elif key not in channels:
                raise McapError(f'a message of channel {key}, which is not described')

    def check_data(self, end: int) -> None:
        """Compares the checksum in the record of the end of the data."""
        (wanted,) = struct.unpack_from('<I', self.read(end + _RECORD.size, 4))
        checksum = 0
        for offset in range(0, end if wanted else 0, _PIECE):
            checksum = zlib.crc32(self.read(offset, min(_PIECE, end - offset)), checksum)
        if checksum != wanted:
            raise McapError('the data have another checksum')


def _number(record: bytes, at: int) -> int:
    return int.from_bytes(record[at : at + 2], 'little')


def _text(record: bytes | memoryview, at: int) -> tuple[str, int]:
    """A text in a record, and where it ends."""
    start = at + 4
    end = start + struct.unpack_from('<I', record, at)[0]
    if end > len(record):
        raise McapError('a text breaks off')
    return str(record[start:end], 'utf-8', 'replace'), end


def _unpacked(packed: memoryview, compression: str, size: int) -> bytes | memoryview:
    """Content of a chunk; no memory is used for more than its size."""
    if not compression:
        return packed
    data: bytes = b''
    if compression == 'zstd':
        known = zstandard.get_frame_parameters(packed).content_size
        if known in (size, zstandard.CONTENTSIZE_UNKNOWN):
            data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    elif compression == 'lz4':
        data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
    else:
        raise McapError(f'a chunk has the compression {compression[:20]!r}, wanted zstd or lz4')
    if len(data) != size:
        raise McapError(f'a chunk of another size than {size}')
    return data


def _written_index(reading: _Reading) -> _Index | None:
    """The index at the end of a file; None: there is none, or not of all of the file."""
    with suppress(Exception):  # a pass over the file tells what is wrong
        end = reading.size - _FOOTER.size
        opcode, summary, magic = _FOOTER.unpack(reading.read(end, _FOOTER.size))
        if opcode == Opcode.FOOTER and magic == MAGIC and 0 < end - summary <= _MAX_SUMMARY:
            return _index_of_summary(reading, summary, end)
    return None


def _index_of_summary(reading: _Reading, summary: int, end: int) -> _Index | None:
    """The index between two places of a file; None: it is not of all of the file."""
    index, statistics, data_end = _Index(), None, 0
    data = reading.read(summary, end - summary)
    for opcode, start, end in reading.records(data):
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            index.describe(opcode, data[start:end])
        elif opcode == Opcode.STATISTICS:
            statistics = _STATISTICS.unpack_from(data, start)
            counts = _by_channel(data, start + _STATISTICS.size, statistics[3])
            index.counts.update(dict(np.frombuffer(counts, _BY_CHANNEL).tolist()))
        elif opcode == Opcode.CHUNK_INDEX:
            first, offset, length, channels = _CHUNK_INDEX.unpack_from(data, start)
            place = start + _CHUNK_INDEX.size
            index.chunks.append(_Chunk(offset, first, _by_channel(data, place, channels)))
            if offset < data_end:
                return None  # not in the order of the file, or one chunk twice
            data_end = offset + length
    if statistics is None or data_end > reading.size:
        return None
    count, chunk_count, start, _ = statistics
    index.start = start if count else NEVER
    schemas = {0, *index.schemas}
    whole = (
        index.counts.total() == count
        and len(index.chunks) == chunk_count
        and (index.chunks or not count)
        and all(key in index.channels and index.channels[key][0] in schemas for key in index.counts)
    )
    return index if whole else None


def _by_channel(data: bytes, start: int, length: int) -> bytes:
    """A table of numbers by channels."""
    if length > _BY_CHANNEL.itemsize * MAX_TOPICS or length > len(data) - start:
        raise McapError(f'a table of {length} bytes')
    return data[start : start + length]


def _index_of_a_pass(reading: _Reading) -> _Index:
    """The index of a file up to its end, or to where it breaks off or is damaged."""
    index, at, opcode = _Index(), len(MAGIC), 0
    try:
        while opcode != Opcode.FOOTER:
            opcode, length = reading.record(at)
            start = at + _RECORD.size
            if opcode == Opcode.CHUNK:
                index.add_chunk(at, reading)
            elif opcode == Opcode.MESSAGE:
                if not _MESSAGE.size <= length <= LARGEST:
                    raise McapError(f'a message of {length} bytes')
                key, _, time, _ = _MESSAGE.unpack(reading.read(start, _MESSAGE.size))
                index.counts[key] += 1
                index.start = min(index.start, time)
                index.times.append(time)
                index.offsets.append(at)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                index.describe(opcode, reading.read(start, min(length, _MAX_DESCRIPTION + 1)))
            elif opcode == Opcode.DATA_END:
                reading.check_data(at)
            at = start + length
        if reading.read(at, len(MAGIC)) != MAGIC:
            raise McapError('another end than that of an MCAP file')
    except ValueError:
        raise  # it takes too much
    except Exception as error:  # noqa: BLE001 - told behind the messages before it
        index.fault = error
    return index
