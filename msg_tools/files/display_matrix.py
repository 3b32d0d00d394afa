"""The display matrix of a video in an MP4 or QuickTime file [ISO 14496-12, 8.3.2].

OpenCV reports only a rotation angle, which is wrong if the matrix mirrors the image.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_tools.files.mp4_boxes import boxes_at, mapped

# Identity matrix, and matrices of clockwise rotations by angle, degrees.
IDENTITY = 1, 0, 0, 1
ROTATIONS = {0: IDENTITY, 90: (0, 1, -1, 0), 180: (-1, 0, 0, -1), 270: (0, -1, 1, 0)}

Matrix = tuple[int, int, int, int]

_MATRIX_OFFSETS = 40, 52  # offset in versions 0 and 1 of the box, bytes


def display_matrix(path: Path) -> Matrix | None:
    """The matrix (a, b, c, d) of the first video track; None if missing or invalid.

    The stored pixel (u, v) is shown at (a u + c v, b u + d v), up to a shift and a scale.
    """
    with mapped(path) as data:
        for start, end in boxes_at(data, 0, len(data), b'moov', b'trak'):
            handlers = boxes_at(data, start, end, b'mdia', b'hdlr')
            if b'vide' not in [data[at + 8 : at + 12] for at, _ in handlers]:
                continue
            for at, last in boxes_at(data, start, end, b'tkhd'):
                at += _MATRIX_OFFSETS[data[at : at + 1] == b'\x01']
                if at + 20 <= last:
                    a, b, _, c, d = struct.unpack_from('>5i', data, at)
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
    """Applies a display matrix, rounded to the nearest quarter turn, to an image (H, W, C)."""
    across, down = matrix[0], matrix[3]
    if is_turned(matrix):
        across, down = matrix[2], matrix[1]
        image = image.swapaxes(0, 1)
    return np.ascontiguousarray(image[:: 1 if down > 0 else -1, :: 1 if across > 0 else -1])
