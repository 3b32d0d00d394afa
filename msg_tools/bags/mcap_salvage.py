"""Finds the intact parts of a damaged MCAP file, in the order of the file, chunk by chunk.

A chunk is intact if its checksum fits or, without a checksum, if it can be decompressed and divided
into records; outside of chunks a record is intact if the file contains all of it. After damage the
search goes on for the next chunk. An intact summary gives the channels whose description was lost,
and the number of messages. The library `mcap` has nothing of the kind: its readers end at damage.
"""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode

from msg_tools.bags.contents import BagError, Channel, reason
from msg_tools.bags.mcap_records import (
    CHUNK_HEAD,
    FOOTER_BYTES,
    MAGIC,
    MAX_BYTES,
    MESSAGE_HEAD,
    RECORD,
    DamageError,
    Fields,
    checksum_of,
    chunk_records,
    read_exactly,
    record_head,
    records_in,
)

# Records before the summary.
_DATA_RECORDS = (
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
)
_DATA_END_BYTES = 4
# As many bytes of the mark at the start may be wrong.
_WRONG_BYTES = 2
# Bytes behind the fixed fields of a compressed chunk.
_COMPRESSIONS = (b'\x04\x00\x00\x00zstd', b'\x03\x00\x00\x00lz4')
_SEARCHED_BYTES = 2**20


class Loss(NamedTuple):
    """A stretch of a file that could not be saved.

    Attributes:
        start, end: bytes of the file; of messages that nothing describes, their chunk.
        why: as the end of a sentence that starts with the name of the file.
    """

    start: int
    end: int
    why: str


class SavedChannel(NamedTuple):
    """A channel with all that is written about it."""

    channel: Channel
    offered_qos: str
    type_hash: str


class SavedMessage(NamedTuple):
    """A message with all that is written about it; times in ns."""

    channel: SavedChannel
    sequence: int
    log_time: int
    publish_time: int
    data: memoryview


class SavedMetadata(NamedTuple):
    """A record of metadata."""

    name: str
    content: dict[str, str]


class SavedAttachment(NamedTuple):
    """An attachment; times in ns."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    data: bytes


Saved = SavedChannel | SavedMessage | SavedMetadata | SavedAttachment


class McapSalvage:
    """A file that may be damaged.

    Raises:
        BagError: not an MCAP file.

    Attributes:
        name: as given.
        profile: 'ros2' for recordings of ROS 2.
        losses: stretches that could not be saved, as far as the file has been read.
        announced: how many messages the file had when it was complete; None where it does not tell.
    """

    def __init__(self, path: Path, name: str) -> None:
        self._path = path
        self.name = name
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._channels: dict[int, tuple[int, str, str, dict[str, str]]] = {}
        self._saved_channels: dict[int, SavedChannel] = {}
        self.profile = 'ros2'
        self.losses: list[Loss] = []
        self.announced: int | None = None
        try:
            with path.open('rb') as file:
                size = file.seek(0, os.SEEK_END)
                file.seek(0)
                self._check_magic(file.read(len(MAGIC)))
                self._read_what_helps(file, size)
        except OSError as error:
            raise BagError(f'{name} can not be read: {reason(error)}') from error

    def content(self) -> Iterator[Saved]:
        """All that is whole; channels come before their messages.

        Raises:
            BagError: the disk can not be read.
        """
        try:
            with self._path.open('rb') as file:
                yield from self._content(file, file.seek(0, os.SEEK_END))
        except OSError as error:
            raise BagError(f'{self.name} can not be read: {reason(error)}') from error

    def _check_magic(self, magic: bytes) -> None:
        wrong = sum(seen != wanted for seen, wanted in zip(magic, MAGIC, strict=False))
        if len(magic) < len(MAGIC):
            raise BagError(f'{self.name} has {len(magic)} bytes: there is nothing to be saved')
        if wrong > _WRONG_BYTES:
            raise BagError(
                f'{self.name} is not a bag: it starts with {magic!r}, wanted an MCAP recording'
            )
        if wrong:
            self.losses.append(Loss(0, len(MAGIC), 'has a damaged mark at its start'))

    def _read_what_helps(self, file: BinaryIO, size: int) -> None:
        """Reads header and summary; their faults are found when `content` reads up to there."""
        with suppress(DamageError):
            opcode, length = record_head(file, len(MAGIC), size)
            if opcode == Opcode.HEADER:
                self.profile = Fields(read_exactly(file, length), len(MAGIC)).text()
        try:
            self._read_summary(file, size)
        except DamageError:
            self.announced = None

    def _read_summary(self, file: BinaryIO, size: int) -> None:
        offset = size - FOOTER_BYTES - len(MAGIC)
        if offset < len(MAGIC):
            raise DamageError('has no end')
        file.seek(offset)
        if record_head(file, offset, size)[0] != Opcode.FOOTER:
            raise DamageError('has no end')
        fields = Fields(read_exactly(file, FOOTER_BYTES - RECORD.size), offset)
        start = fields.u64()
        fields.skip(8)
        checksum = fields.u32()
        if file.read(len(MAGIC)) != MAGIC or not 0 < start < offset:
            raise DamageError('has no summary')
        if checksum and checksum_of(file, start, offset + RECORD.size + 16) != checksum:
            raise DamageError('has a damaged summary')
        at = file.seek(start)
        while at < offset:
            opcode, length = record_head(file, at, size)
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._register(opcode, Fields(read_exactly(file, length), at))
            elif opcode == Opcode.STATISTICS:
                self.announced = Fields(read_exactly(file, length), at).u64()
            at = file.seek(at + RECORD.size + length)

    def _content(self, file: BinaryIO, size: int) -> Iterator[Saved]:
        offset = len(MAGIC)
        summary = False
        while offset < size:
            file.seek(offset)
            end = size
            try:
                opcode, length = record_head(file, offset, size)
                end = offset + RECORD.size + length
                if opcode == Opcode.FOOTER:
                    if end + len(MAGIC) == size and file.seek(end) and file.read() == MAGIC:
                        return
                    raise DamageError(f'is damaged at byte {offset}: it seems to end there')
                if opcode == Opcode.DATA_END and length == _DATA_END_BYTES:
                    summary = True
                elif not summary:
                    yield from self._record(file, opcode, length, offset)
            except DamageError as damage:
                if not self._follows(file, end, size):
                    end = self._next_chunk(file, offset + 1, size)
                self.losses.append(Loss(offset, end, str(damage)))
            offset = end
        if not self.losses or self.losses[-1].end != size:
            self.losses.append(Loss(size, size, f'breaks off after {size} bytes'))

    def _record(self, file: BinaryIO, opcode: int, length: int, offset: int) -> Iterator[Saved]:
        """Content of a record of the data, all of it or an error."""
        if opcode not in _DATA_RECORDS or length > MAX_BYTES:
            raise DamageError(
                f'is damaged at byte {offset}: record of type {opcode} with {length} bytes'
            )
        if opcode == Opcode.CHUNK:
            yield from self._chunk(read_exactly(file, length), offset)
        elif opcode == Opcode.MESSAGE:
            data = memoryview(read_exactly(file, length))
            message = self._message(data)
            if message is None:
                raise DamageError(f'has a message at byte {offset} that nothing describes')
            yield message
        elif opcode == Opcode.HEADER:
            Fields(read_exactly(file, length), offset).text()
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield from self._described(
                self._register(opcode, Fields(read_exactly(file, length), offset))
            )
        elif opcode == Opcode.METADATA:
            fields = Fields(read_exactly(file, length), offset)
            yield SavedMetadata(fields.text(), fields.texts())
        elif opcode == Opcode.ATTACHMENT:
            yield _attachment(read_exactly(file, length), offset)
        else:
            # An index is not needed; but a record that looks like one may be another, damaged.
            fields = Fields(read_exactly(file, length), offset)
            fields.skip(2)
            if fields.u32() != length - 6:
                raise DamageError(f'is damaged at byte {offset}: an index of {length} bytes')

    def _chunk(self, body: bytes, offset: int) -> Iterator[Saved]:
        # Wholly, before anything of it is given out.
        data = chunk_records(body, offset)
        records = list(records_in(data, offset))
        undescribed: Counter[int] = Counter()
        for opcode, start, end in records:
            record = data[start:end]
            if opcode == Opcode.MESSAGE:
                message = self._message(record)
                if message is None:
                    undescribed[int.from_bytes(record[:2], 'little')] += 1
                else:
                    yield message
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                yield from self._described(self._register(opcode, Fields(record, offset)))
        if undescribed:
            self.losses.append(
                Loss(
                    offset,
                    offset + RECORD.size + len(body),
                    f'has {undescribed.total()} messages in the chunk at byte {offset} that '
                    'nothing describes',
                )
            )

    def _register(self, opcode: int, fields: Fields) -> int | None:
        """Keeps a schema or a channel; the key of a channel."""
        key = fields.u16()
        if opcode == Opcode.SCHEMA:
            self._schemas[key] = fields.text(), fields.text(), fields.block()
            self._saved_channels.clear()
            return None
        self._channels[key] = fields.u16(), fields.text(), fields.text(), fields.texts()
        self._saved_channels.pop(key, None)
        return key

    def _described(self, key: int | None) -> Iterator[SavedChannel]:
        """A channel without messages is worth keeping as well."""
        channel = None if key is None else self._saved_channel(key)
        if channel is not None:
            yield channel

    def _saved_channel(self, key: int) -> SavedChannel | None:
        known = self._saved_channels.get(key)
        if known is not None:
            return known
        schema, topic, encoding, metadata = self._channels.get(key, (-1, '', '', {}))
        if schema and schema not in self._schemas:
            return None
        msgtype, definition_encoding, definition = self._schemas.get(schema, ('', '', b''))
        known = self._saved_channels[key] = SavedChannel(
            Channel(topic, msgtype, encoding, definition_encoding, definition),
            metadata.get('offered_qos_profiles', ''),
            metadata.get('topic_type_hash', ''),
        )
        return known

    def _message(self, record: memoryview) -> SavedMessage | None:
        """A message, None where nothing describes it."""
        key, sequence, log_time, publish_time = MESSAGE_HEAD.unpack_from(record)
        channel = self._saved_channel(key)
        if channel is None:
            return None
        data = record[MESSAGE_HEAD.size :]
        return SavedMessage(channel, sequence, log_time, publish_time, data)

    @staticmethod
    def _follows(file: BinaryIO, offset: int, size: int) -> bool:
        """Whether a record of the data seems to begin somewhere."""
        try:
            file.seek(offset)
            return record_head(file, offset, size)[0] in (*_DATA_RECORDS, Opcode.DATA_END)
        except DamageError:
            return False

    @staticmethod
    def _next_chunk(file: BinaryIO, start: int, size: int) -> int:
        """Where the next compressed chunk seems to begin, `size` where none does."""
        before = RECORD.size + CHUNK_HEAD.size
        at = start
        while at < size:
            file.seek(at)
            piece = file.read(_SEARCHED_BYTES + before + 8)
            found = [
                offset
                for mark in _COMPRESSIONS
                for offset in _places(piece, mark, before)
                if piece[offset] == Opcode.CHUNK
            ]
            for offset in sorted(found):
                (length,) = RECORD.unpack_from(piece, offset)[1:]
                file.seek(at + offset + before)
                fields = Fields(file.read(16), at + offset)
                try:
                    compression = len(fields.text()) + 4
                    packed = fields.u64()
                except DamageError:
                    continue
                whole = length == CHUNK_HEAD.size + compression + 8 + packed
                if whole and at + offset + RECORD.size + length <= size:
                    return at + offset
            at += _SEARCHED_BYTES
        return size


def _places(piece: bytes, mark: bytes, before: int) -> Iterator[int]:
    """Where records begin that have a mark `before` bytes behind their beginning."""
    at = piece.find(mark, before)
    while at >= 0:
        yield at - before
        at = piece.find(mark, at + 1)


def _attachment(body: bytes, offset: int) -> SavedAttachment:
    fields = Fields(body, offset)
    log_time, create_time = fields.u64(), fields.u64()
    name, media_type = fields.text(), fields.text()
    data = bytes(fields.take(fields.u64()))
    checksum = fields.u32()
    if checksum and zlib.crc32(body[:-4]) != checksum:
        raise DamageError(f'is damaged at byte {offset}: the checksum of an attachment differs')
    return SavedAttachment(name, media_type, log_time, create_time, data)
