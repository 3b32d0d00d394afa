"""The boxes of which MP4 and QuickTime files are made [ISO 14496-12, 4.2]."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from typing import TypeAlias

Data: TypeAlias = 'bytes | mmap.mmap'


def boxes(data: Data, start: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Kinds of the boxes in a part of a file, and where their contents begin and end.

    Boxes that are damaged, and all behind them, are left out.
    """
    while start + 8 <= end:
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
    """Where the contents of boxes begin and end that lie at a path of kinds."""
    for kind, first, last in boxes(data, start, end):
        if kind == kinds[0] and kinds[1:]:
            yield from boxes_at(data, first, last, *kinds[1:])
        elif kind == kinds[0]:
            yield first, last
