"""Decompression of chunks, messages and files."""

from __future__ import annotations

import io

import lz4.frame
import numpy as np
import pytest
import zstandard

from msg_tools.bags import mcap_records
from msg_tools.bags.mcap_records import (
    DecompressionError,
    decompress,
    decompress_file,
    decompress_zstd,
)

DATA = np.random.default_rng(0).integers(0, 4, 100_000, dtype=np.uint8).tobytes()


def zstd_without_size(data: bytes) -> bytes:
    compressor = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    return compressor.compress(data) + compressor.flush()


PACKED = {
    'none': ('', DATA),
    'zstd': ('zstd', zstandard.compress(DATA)),
    'zstd-without-size': ('zstd', zstd_without_size(DATA)),
    'lz4': ('lz4', lz4.frame.compress(DATA)),
    'lz4-without-size': ('lz4', lz4.frame.compress(DATA, store_size=False)),
}


@pytest.mark.parametrize('kind', list(PACKED))
def test_round_trip_and_wrong_sizes(kind: str) -> None:
    compression, packed = PACKED[kind]
    assert decompress(packed, compression, len(DATA)) == DATA
    assert decompress(memoryview(packed), compression, len(DATA)) == DATA
    for size in (0, len(DATA) - 1, len(DATA) + 1, 2**28, 2**40):
        with pytest.raises(DecompressionError):
            decompress(packed, compression, size)


@pytest.mark.parametrize('kind', list(PACKED))
def test_cut_data(kind: str) -> None:
    compression, packed = PACKED[kind]
    for count in (0, 1, 3, 4, 5, 20, len(packed) // 2, len(packed) - 1):
        with pytest.raises(DecompressionError):
            decompress(packed[:count], compression, len(DATA))


def test_unknown_compression() -> None:
    with pytest.raises(DecompressionError, match="compression 'brotli' is not known"):
        decompress(b'', 'brotli', 0)


def test_more_than_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcap_records, 'MAX_BYTES', 50_000)
    for packed in (zstandard.compress(DATA), zstd_without_size(DATA)):
        with pytest.raises(DecompressionError):
            decompress_zstd(packed)
    with pytest.raises(DecompressionError, match='100000 bytes are announced, the limit is 50000'):
        decompress(DATA, '', len(DATA))


def test_files_may_have_several_frames() -> None:
    packed = zstandard.compress(DATA) + zstd_without_size(b'end')
    assert b''.join(decompress_file(io.BytesIO(packed))) == DATA + b'end'
    assert DATA.startswith(b''.join(decompress_file(io.BytesIO(packed[:10_000]))))
    with pytest.raises(DecompressionError):
        list(decompress_file(io.BytesIO(b'\x28\xb5\x2f\xfd' + b'\xff' * 20)))
