"""Records of an MCAP file, their fields and their decompression, with checked lengths."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.opcode import Opcode

from msg_tools.bags.contents import reason

MAX_BYTES = 2**29  # longest record, chunk or message that is read; the largest real ones are images
PIECE_BYTES = 2**20
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'

_UNKNOWN_SIZE = -1


MAGIC = b'\x89MCAP0\r\n'

# Type and length; the fixed fields of a message and of a chunk.
RECORD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')
CHUNK_HEAD = struct.Struct('<QQQI')

FOOTER_BYTES = RECORD.size + 20

# These are read whole, and small; a larger one is damage.
_READ_WHOLE = (
    Opcode.HEADER,
    Opcode.FOOTER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.DATA_END,
)
_SMALL_RECORD_BYTES = 2**24

_U16 = struct.Struct('<H')
_U32 = struct.Struct('<I')
_U64 = struct.Struct('<Q')


class DecompressionError(ValueError):
    """Compressed bytes that are damaged, or not what was announced."""


def decompress(data: bytes | memoryview, compression: str, size: int) -> bytes:
    """Bytes of a chunk.

    Args:
        compression: '', 'zstd' or 'lz4', as MCAP names them.

    Raises:
        DecompressionError: unknown compression, damaged data, another size.
    """
    if size > MAX_BYTES:
        raise DecompressionError(f'{size} bytes are announced, the limit is {MAX_BYTES}')
    if compression == '':
        result = bytes(data)
    elif compression == 'zstd':
        result = decompress_zstd(data, size)
    elif compression == 'lz4':
        result = _decompress_lz4(data, size)
    else:
        raise DecompressionError(f'compression {compression!r} is not known, wanted zstd or lz4')
    if len(result) != size:
        raise DecompressionError(f'{len(result)} bytes instead of the {size} announced')
    return result


def decompress_zstd(data: bytes | memoryview, size: int | None = None) -> bytes:
    """Bytes of one zstd frame.

    Args:
        size: of the result, where it is known from elsewhere.

    Raises:
        DecompressionError: damaged or cut data, another size, more than `MAX_BYTES`.
    """
    try:
        announced = zstandard.frame_content_size(data)
        decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_BYTES)
        if announced == _UNKNOWN_SIZE:
            limit = MAX_BYTES if size is None else size
            pieces = []
            total = 0
            with decompressor.stream_reader(data) as stream:
                # One byte more than wanted shows that there is more.
                while piece := stream.read(min(PIECE_BYTES, limit + 1 - total)):
                    pieces.append(piece)
                    total += len(piece)
            if total > limit:
                raise DecompressionError(f'more than {limit} bytes')
            return b''.join(pieces)
        if announced > MAX_BYTES or size not in (None, announced):
            raise DecompressionError(
                f'{announced} bytes are announced, wanted {MAX_BYTES if size is None else size}'
            )
        return decompressor.decompress(data)
    except zstandard.ZstdError as error:
        raise DecompressionError(f'zstd data is damaged: {reason(error)}') from error


def _decompress_lz4(data: bytes | memoryview, size: int) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    try:
        result: bytes = decompressor.decompress(data, max_length=size + 1)
    except RuntimeError as error:
        raise DecompressionError(f'lz4 data is damaged: {reason(error)}') from error
    if not decompressor.eof:
        raise DecompressionError(f'lz4 data does not end after the {size} bytes announced')
    return result


def decompress_file(file: BinaryIO) -> Iterator[bytes]:
    """Pieces of a zstd file, which may have several frames; ends quietly where the file was cut.

    Raises:
        DecompressionError: damaged data.
    """
    decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_BYTES)
    try:
        with decompressor.stream_reader(file, read_across_frames=True, closefd=False) as stream:
            while piece := stream.read(PIECE_BYTES):
                yield piece
    except zstandard.ZstdError as error:
        raise DecompressionError(f'zstd data is damaged: {reason(error)}') from error


class DamageError(Exception):
    """Damage of a file, as the end of a sentence that starts with its name."""


class Fields:
    """Fields of a record, in turn; nothing is read beyond its end."""

    def __init__(self, body: bytes | memoryview, offset: int) -> None:
        self._body = memoryview(body)
        self._at = 0
        self._offset = offset

    def take(self, count: int) -> memoryview:
        """The next bytes."""
        result = self._body[self._at : self._at + count]
        if len(result) != count:
            raise DamageError(f'is damaged at byte {self._offset}: a record breaks off')
        self._at += count
        return result

    def skip(self, count: int) -> None:
        """Passes over the next bytes."""
        self.take(count)

    def u16(self) -> int:
        """The next two bytes as a number."""
        value: int = _U16.unpack(self.take(2))[0]
        return value

    def u32(self) -> int:
        """The next four bytes as a number."""
        value: int = _U32.unpack(self.take(4))[0]
        return value

    def u64(self) -> int:
        """The next eight bytes as a number."""
        value: int = _U64.unpack(self.take(8))[0]
        return value

    def block(self) -> bytes:
        """Bytes after their length."""
        return bytes(self.take(self.u32()))

    def text(self) -> str:
        """Text after its length."""
        try:
            return self.block().decode()
        except UnicodeDecodeError:
            raise DamageError(f'is damaged at byte {self._offset}: a name is not UTF-8') from None

    def texts(self) -> dict[str, str]:
        """Texts by name."""
        entries = Fields(self.block(), self._offset)
        found: dict[str, str] = {}
        while entries._at < len(entries._body):
            name = entries.text()
            found[name] = entries.text()
        return found

    def statistics(self) -> Counter[int] | None:
        """Messages of each channel; None where the writer gave only their total."""
        total = self.u64()
        self.skip(34)
        entries = Fields(self.block(), self._offset)
        counts: Counter[int] = Counter()
        while entries._at < len(entries._body):
            key = entries.u16()
            counts[key] += entries.u64()
        return counts if counts.total() == total else None


def record_head(file: BinaryIO, offset: int, size: int) -> tuple[int, int]:
    """Type and length of the record at `offset`, which lies in the file whole."""
    if offset == size:
        raise DamageError(f'breaks off after {size} bytes: its end is missing')
    if offset + RECORD.size > size:
        raise DamageError(f'breaks off after {size} bytes, inside a record')
    opcode: int
    length: int
    opcode, length = RECORD.unpack(read_exactly(file, RECORD.size))
    if opcode == 0:
        raise DamageError(f'is damaged at byte {offset}: record of type 0')
    if opcode in (Opcode.MESSAGE, Opcode.CHUNK):
        smallest = MESSAGE_HEAD.size if opcode == Opcode.MESSAGE else CHUNK_HEAD.size
        largest = MAX_BYTES
    else:
        smallest = 0
        largest = _SMALL_RECORD_BYTES if opcode in _READ_WHOLE else size
    if not smallest <= length <= largest:
        raise DamageError(
            f'is damaged at byte {offset}: record of type {opcode} with {length} bytes'
        )
    if offset + RECORD.size + length > size:
        raise DamageError(
            f'breaks off after {size} bytes: the record at byte {offset} has {length} bytes'
        )
    return opcode, length


def read_exactly(file: BinaryIO, count: int) -> bytes:
    """Bytes that are known to be there."""
    data = file.read(count)
    if len(data) != count:
        raise DamageError('became shorter while it was read')
    return data


def chunk_records(body: bytes, offset: int) -> memoryview:
    """The records of a chunk, decompressed and compared with its checksum.

    Args:
        offset: by which texts of errors name the chunk.
    """
    fields = Fields(body, offset)
    _, _, size, checksum = CHUNK_HEAD.unpack(fields.take(CHUNK_HEAD.size))
    compression = fields.text()
    try:
        data = decompress(fields.take(fields.u64()), compression, size)
    except DecompressionError as error:
        raise DamageError(f'is damaged in the chunk at byte {offset}: {error}') from None
    if checksum and zlib.crc32(data) != checksum:
        raise DamageError(f'is damaged in the chunk at byte {offset}: its checksum differs')
    return memoryview(data)


def records_in(data: memoryview, offset: int) -> Iterator[tuple[int, int, int]]:
    """Type, start and end of the body of records that follow each other, those of a chunk say.

    Args:
        offset: by which texts of errors name the chunk.
    """
    place = f'the chunk at byte {offset}'
    at = 0
    while at < len(data):
        body = at + RECORD.size
        if body > len(data):
            raise DamageError(f'is damaged in {place}: a record breaks off')
        opcode, length = RECORD.unpack_from(data, at)
        at = body + length
        if at > len(data):
            raise DamageError(f'is damaged in {place}: a record breaks off')
        if opcode == Opcode.MESSAGE and length < MESSAGE_HEAD.size:
            raise DamageError(f'is damaged in {place}: a message has {length} bytes')
        yield opcode, body, at


def checksum_of(file: BinaryIO, start: int, end: int) -> int:
    """CRC-32 of a stretch of the file."""
    file.seek(start)
    checksum = 0
    while start < end:
        piece = read_exactly(file, min(PIECE_BYTES, end - start))
        checksum = zlib.crc32(piece, checksum)
        start += len(piece)
    return checksum
