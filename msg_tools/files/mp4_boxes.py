"""Reads the boxes of MP4 and QuickTime files [ISO 14496-12, 4.2]."""

from __future__ import annotations

import mmap
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

from msg_tools.files.bounded_file import open_regular

Data: TypeAlias = 'bytes | mmap.mmap'

_MAX_BOXES = 300_000  # maximum number of boxes within a box; long videos have up to two per image


@contextmanager
def mapped(path: Path) -> Iterator[Data]:
    """Maps the content of a file into memory.

    Raises:
        OSError: the file can not be read, or is not a regular file.
    """
    with open_regular(path) as file:
        if not os.fstat(file.fileno()).st_size:
            yield b''
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            yield data


def boxes(data: Data, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Yields kind, content start and content end of the boxes in a part of a file.

    A damaged box and all later boxes are left out.
    """
    for _ in range(_MAX_BOXES):
        if start + 8 > end:
            return
        size, kind = struct.unpack_from('>I4s', data, start)
        head = 8
        if size == 1 and start + 16 <= end:
            size, head = struct.unpack_from('>Q', data, start + 8)[0], 16
        elif size == 0:
            size = end - start
        if size < head:
            return
        yield kind, start + head, min(start + size, end)
        start += size


def boxes_at(data: Data, start: int, end: int, *kinds: bytes) -> Iterator[tuple[int, int]]:
    """Yields content start and content end of the boxes at a path of nested kinds."""
    for kind, first, last in boxes(data, start, end):
        if kind == kinds[0] and kinds[1:]:
            yield from boxes_at(data, first, last, *kinds[1:])
        elif kind == kinds[0]:
            yield first, last
