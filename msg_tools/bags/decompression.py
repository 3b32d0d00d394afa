"""Decompression of zstd and lz4 with limits on the size of the result."""

from __future__ import annotations

from collections.abc import Iterator
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from msg_tools.bags.contents import reason

MAX_BYTES = 2**29  # longest record, chunk or message that is read; the largest real ones are images
PIECE_BYTES = 2**20
ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'

_UNKNOWN_SIZE = -1


class DecompressionError(ValueError):
    """Compressed bytes that are damaged, or not what was announced."""


def decompress(data: bytes | memoryview, compression: str, size: int) -> bytes:
    """Bytes of a chunk.

    Args:
        data: compressed bytes.
        compression: '', 'zstd' or 'lz4', as MCAP names them.
        size: of the result.

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
        data: the frame.
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
