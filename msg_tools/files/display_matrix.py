"""How a video is shown: the display matrix in an MP4 or QuickTime file [ISO 14496-12, 8.3.2].

OpenCV tells an angle only, which is wrong where the matrix mirrors.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

# Images as stored; after a turn to the right by 90 degrees; by 180; by 270.
STORED = 1, 0, 0, 1
TURNED = {0: STORED, 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}

Matrix = tuple[int, int, int, int]

_MATRIX_AT = 40, 52  # bytes, in versions 0 and 1 of the box


def display_matrix(path: Path) -> Matrix | None:
    """The matrix (a, b, c, d) of the first track of images; None: not such a file, or damaged.

    The stored pixel (u, v) is shown at (a u + c v, b u + d v), up to a shift and a scale.
    """
    with path.open('rb') as file:
        for begin, end in _boxes(file, 0, path.stat().st_size, b'moov', b'trak'):
            if b'vide' not in _contents(file, begin, end, 8, 12, b'mdia', b'hdlr'):
                continue
            for head in _contents(file, begin, end, 0, 100, b'tkhd'):
                at = _MATRIX_AT[head[:1] == b'\x01']
                if len(head) >= at + 20:
                    a, b, _, c, d = struct.unpack_from('>5i', head, at)
                    return (a, b, c, d) if a * d != b * c else None
    return None


def is_mirrored(matrix: Matrix) -> bool:
    """Whether a matrix shows the mirror image."""
    a, b, c, d = matrix
    return a * d < b * c


def is_turned(matrix: Matrix) -> bool:
    """Whether rows of the stored image are shown as columns."""
    return abs(matrix[0]) < abs(matrix[1])


def shown(image: NDArray[Any], matrix: Matrix) -> NDArray[Any]:
    """An image (H, W, C) as a matrix shows it, to the nearest quarter turn."""
    across, down = matrix[0], matrix[3]
    if is_turned(matrix):
        across, down = matrix[2], matrix[1]
        image = image.swapaxes(0, 1)
    return np.ascontiguousarray(image[:: 1 if down > 0 else -1, :: 1 if across > 0 else -1])


def _contents(
    file: BinaryIO, begin: int, end: int, first: int, last: int, *kinds: bytes
) -> Iterator[bytes]:
    """Bytes `first` to `last` of the boxes of some kinds."""
    for at, stop in _boxes(file, begin, end, *kinds):
        file.seek(at + first)
        yield file.read(min(last, stop - at) - first) if stop - at > first else b''


def _boxes(file: BinaryIO, begin: int, end: int, *kinds: bytes) -> Iterator[tuple[int, int]]:
    """Begins and ends of the contents of boxes of a kind, in those of the kinds before it."""
    while begin + 8 <= end:
        file.seek(begin)
        size, kind, large = struct.unpack('>I4sQ', file.read(16).ljust(16, b'\0'))
        inner = begin + (16 if size == 1 else 8)
        stop = {0: end, 1: begin + large}.get(size, begin + size)
        if not inner <= stop <= end:
            return
        if kind == kinds[0] and kinds[1:]:
            yield from _boxes(file, inner, stop, *kinds[1:])
        elif kind == kinds[0]:
            yield inner, stop
        begin = stop
