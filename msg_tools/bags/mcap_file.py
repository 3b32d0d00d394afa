"""Reads one MCAP file in the order of log times, and checks every length and checksum.

Written against the MCAP specification, version 0 (https://mcap.dev/spec). The reader of `rosbags`
wants the profile `ros2` and an index or sorted messages, and passes some damage by; the one of
`mcap` wants all channels in the summary, takes short reads for data and loads a file without index
whole. So the framing is done here:

- A pass over the record headers finds the chunks and the bare messages. The index at the end of the
  file is not needed, so a recording that was cut off reads like any other, up to where it breaks.
- No length is believed beyond the file or `MAX_BYTES`. Memory holds the chunks that overlap in
  time.
- Checksums of chunks, of the data section and of the summary are compared where the file has them,
  and the number of messages with the file's own statistics.
- Damage is raised as `BagError` once the messages before it are out.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode

from msg_tools.bags.contents import BagError, Channel, Source, StoredMessage, merge, reason
from msg_tools.bags.mcap_records import (
    CHUNK_HEAD,
    MAGIC,
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

# Bare messages, outside of chunks, are read together up to this size.
RUN_BYTES = 2**20
# Chunks that overlap in time have to be in memory together.
MAX_OPEN_BYTES = 2**30


class _Block(NamedTuple):
    """A chunk, or a run of bare messages: a stretch of the file that is read at once."""

    start: int  # log times of the first and last message, ns
    end: int
    offset: int  # in the file
    size: int
    is_chunk: bool


class _Pass:
    """State of one pass over the messages."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.open_bytes = 0
        self.seen: Counter[int] = Counter()


class McapFile:
    """An MCAP file.

    Raises:
        BagError: not an MCAP file.

    Attributes:
        counts: number of messages of each channel.
        start, end: log times in ns of the first and the last message; None when there is none.
        damage: damage that is already known, for example a missing end.
    """

    def __init__(self, path: Path, name: str) -> None:
        self._path = path
        self._name = name
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._channels: dict[int, tuple[int, str, str]] = {}  # schema, topic, encoding
        self._blocks: list[_Block] = []
        self._bare_counts: Counter[int] = Counter()
        self._statistics: Counter[int] | None = None
        self._data_checksum: tuple[int, int] | None = None  # bytes from the start, CRC-32 of them
        self.damage: str | None = None
        try:
            with path.open('rb') as file:
                self._scan(file)
                counts = self._count(file)
        except OSError as error:
            raise BagError(f'{name} can not be read: {reason(error)}') from error
        self.counts: dict[Channel, int] = {}
        for key in sorted(self._channels):
            channel = self._channel(key)
            if channel is not None:
                self.counts[channel] = self.counts.get(channel, 0) + counts[key]
        # A chunk without messages has start and end 0, or a start after its end.
        spans = [block for block in self._blocks if block.start <= block.end and block.end > 0]
        empty = 0 if self._blocks else None
        self.start: int | None = min((span.start for span in spans), default=empty)
        self.end: int | None = max((span.end for span in spans), default=empty)

    def messages(
        self, wanted: Callable[[Channel], bool] = lambda channel: True
    ) -> Iterator[tuple[int, StoredMessage]]:
        """Log time in ns and message, by log time, then by place in the file.

        Raises:
            BagError: where the file is damaged, after the messages before the damage.
        """
        try:
            with self._path.open('rb') as file:
                progress = _Pass(file)
                yield from merge(
                    Source(block.start, order, partial(self._read, block, wanted, progress))
                    for order, block in enumerate(self._blocks)
                )
                self._check_whole(progress)
        except OSError as error:
            raise BagError(f'{self._name} can not be read: {reason(error)}') from error
        except DamageError as damage:
            raise BagError(
                f'{self._name} {damage}; `python -m hmt_ros recover` makes a bag of what is whole'
            ) from None

    # Finding the blocks

    def _scan(self, file: BinaryIO) -> None:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        self._check_magic(file.read(len(MAGIC)), size)
        try:
            offset = self._scan_data(file, size)
            known = dict(self._schemas), dict(self._channels)
            try:
                self._statistics = self._scan_summary(file, offset, size)
            except DamageError:
                self._schemas, self._channels = known
                raise
        except DamageError as damage:
            self.damage = str(damage)

    def _check_magic(self, magic: bytes, size: int) -> None:
        if magic == MAGIC:
            return
        if size == 0:
            raise BagError(f'{self._name} is empty, wanted an MCAP recording')
        if magic == MAGIC[:size]:
            raise BagError(f'{self._name} breaks off after {size} bytes, nothing can be read')
        raise BagError(
            f'{self._name} is not a bag: it starts with {magic!r}, wanted an MCAP recording'
        )

    def _scan_data(self, file: BinaryIO, size: int) -> int:
        """Fills in the blocks; returns the offset behind the data section."""
        offset = len(MAGIC)
        run: _Block | None = None
        while True:
            opcode, length = record_head(file, offset, size)
            body = offset + RECORD.size
            if (opcode == Opcode.HEADER) != (offset == len(MAGIC)):
                raise DamageError(f'is damaged at byte {offset}: record of type {opcode}')
            if opcode == Opcode.MESSAGE:
                key, _, time, _ = MESSAGE_HEAD.unpack(read_exactly(file, MESSAGE_HEAD.size))
                self._bare_counts[key] += 1
                bytes_here = RECORD.size + length
                if run and run.offset + run.size == offset and run.size < RUN_BYTES:
                    run = _Block(
                        min(run.start, time),
                        max(run.end, time),
                        run.offset,
                        run.size + bytes_here,
                        is_chunk=False,
                    )
                    self._blocks[-1] = run
                else:
                    run = _Block(time, time, offset, bytes_here, is_chunk=False)
                    self._blocks.append(run)
            elif opcode == Opcode.CHUNK:
                start, end, _, _ = CHUNK_HEAD.unpack(read_exactly(file, CHUNK_HEAD.size))
                self._blocks.append(_Block(start, end, body, length, is_chunk=True))
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._register(opcode, read_exactly(file, length), offset)
            elif opcode == Opcode.DATA_END:
                fields = Fields(read_exactly(file, length), offset)
                self._data_checksum = offset, fields.u32()
                return body + length
            elif opcode == Opcode.FOOTER:
                return offset
            offset = file.seek(body + length)

    def _scan_summary(self, file: BinaryIO, start: int, size: int) -> Counter[int] | None:
        """Messages of each channel as the file counts them, None where it does not."""
        statistics: Counter[int] | None = None
        offset = file.seek(start)
        while True:
            opcode, length = record_head(file, offset, size)
            end = offset + RECORD.size + length
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._register(opcode, read_exactly(file, length), offset)
            elif opcode == Opcode.STATISTICS:
                statistics = Fields(read_exactly(file, length), offset).statistics()
            elif opcode == Opcode.FOOTER:
                fields = Fields(read_exactly(file, length), offset)
                fields.skip(16)
                checksum = fields.u32()
                if file.read(len(MAGIC)) != MAGIC:
                    raise DamageError(f'is damaged at byte {end}: the mark of its end is missing')
                if end + len(MAGIC) != size:
                    raise DamageError(f'has {size - end - len(MAGIC)} bytes after its end')
                checked = offset + RECORD.size + 16
                if checksum and checksum_of(file, start, checked) != checksum:
                    raise DamageError('is damaged: the checksum of its summary differs')
                return statistics
            offset = file.seek(end)

    def _count(self, file: BinaryIO) -> Counter[int]:
        """Messages of each channel; reads all chunks where the summary does not tell."""
        statistics = self._statistics
        if statistics is not None and all(self._channel(key) for key in statistics):
            return statistics
        counts = self._bare_counts.copy()
        for index, block in enumerate(self._blocks):
            if block.is_chunk:
                try:
                    records = self._load(block, file)
                    counts.update(key for _, key, _ in self._messages_in(records, block))
                except DamageError as damage:
                    self._blocks = self._blocks[:index]
                    self.damage = str(damage)
                    break
        return counts

    # Reading a block

    def _read(
        self, block: _Block, wanted: Callable[[Channel], bool], progress: _Pass
    ) -> Iterator[tuple[int, StoredMessage]]:
        records = self._load(block, progress.file)
        progress.open_bytes += len(records)
        if progress.open_bytes > MAX_OPEN_BYTES:
            raise BagError(
                f'{self._name} has over {MAX_OPEN_BYTES} bytes in chunks that overlap at '
                f'{block.start} ns: sort it first, for example with `mcap sort`'
            )
        messages = []
        channels: dict[int, Channel] = {}
        for time, key, data in self._messages_in(records, block):
            progress.seen[key] += 1
            channel = channels.get(key) or self._channel(key)
            if channel is None:
                raise DamageError(
                    f'is damaged in the chunk at byte {block.offset}: message of channel {key}, '
                    'which is not described'
                )
            channels[key] = channel
            if time < block.start:
                raise DamageError(
                    f'is damaged in the chunk at byte {block.offset}: it starts at {block.start} '
                    f'ns, but has a message of {time} ns'
                )
            if wanted(channel):
                messages.append((time, StoredMessage(channel, data)))
        messages.sort(key=lambda message: message[0])
        yield from messages
        progress.open_bytes -= len(records)

    def _load(self, block: _Block, file: BinaryIO) -> memoryview:
        """Records of a block, decompressed and compared with the checksum of the chunk."""
        file.seek(block.offset)
        data = read_exactly(file, block.size)
        if not block.is_chunk:
            return memoryview(data)
        return chunk_records(data, block.offset)

    def _messages_in(
        self, data: memoryview, block: _Block
    ) -> Iterator[tuple[int, int, memoryview]]:
        """Log time, channel and data of the messages, in the order of the file."""
        for opcode, start, end in records_in(data, block.offset):
            if opcode == Opcode.MESSAGE:
                key, _, time, _ = MESSAGE_HEAD.unpack_from(data, start)
                yield time, key, data[start + MESSAGE_HEAD.size : end]
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._register(opcode, data[start:end], block.offset)

    def _register(self, opcode: int, body: bytes | memoryview, offset: int) -> None:
        fields = Fields(body, offset)
        key = fields.u16()
        if opcode == Opcode.SCHEMA:
            schema = fields.text(), fields.text(), fields.block()
            if self._schemas.setdefault(key, schema) != schema:
                raise DamageError(f'is damaged at byte {offset}: schema {key} is given twice')
            return
        channel = fields.u16(), fields.text(), fields.text()
        if self._channels.setdefault(key, channel) != channel:
            raise DamageError(f'is damaged at byte {offset}: channel {key} is given twice')

    def _channel(self, key: int) -> Channel | None:
        """A channel, None as long as it or its schema has not been met."""
        schema, topic, encoding = self._channels.get(key, (-1, '', ''))
        if schema == 0:
            return Channel(topic, '', encoding, '', b'')
        if schema not in self._schemas:
            return None
        return Channel(topic, self._schemas[schema][0], encoding, *self._schemas[schema][1:])

    def _check_whole(self, progress: _Pass) -> None:
        if self.damage is not None:
            raise DamageError(self.damage)
        if self._statistics is not None and +self._statistics != progress.seen:
            raise DamageError(
                f'is damaged: {progress.seen.total()} messages were found, '
                f'its statistics say {self._statistics.total()}'
            )
        if self._data_checksum is not None:
            end, checksum = self._data_checksum
            if checksum and checksum_of(progress.file, 0, end) != checksum:
                raise DamageError('is damaged: the checksum of its data differs')
