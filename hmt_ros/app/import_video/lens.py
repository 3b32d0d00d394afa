"""Reads the focal length from the metadata of a video file, where Apple phones write it.

The key is in the metadata of the movie or of its track (QuickTime File Format, Metadata): the box
`keys` lists names, and the box `ilst` has a value for the index of each name.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

from msg_tools.files.mp4_boxes import Data, boxes, boxes_at, mapped

KEY = b'com.apple.quicktime.camera.focal_length.35mm_equivalent'
# Width of a picture on 35 mm film, and range of plausible 35 mm equivalent focal lengths, mm.
FILM_WIDTH, FOCAL_LENGTH_LIMITS = 36.0, (6.0, 1200.0)
# Relative standard deviation of a focal length from metadata, which do not include the cropping for
# stabilisation and aspect ratio.
METADATA_FOV_SIGMA = 0.1
# Type codes of values that are not integers.
_TEXT_TYPE, _FLOAT_TYPES = 1, {23: '>f', 24: '>d'}


def metadata_fov(path: Path) -> float | None:
    """The field of view along the longer side of the images, degrees; None if unknown."""
    with mapped(path) as data:
        try:
            focal = next(_focal_lengths(data), math.nan)
        except (ValueError, struct.error):
            return None
    low, high = FOCAL_LENGTH_LIMITS
    return math.degrees(2.0 * math.atan(0.5 * FILM_WIDTH / focal)) if low <= focal <= high else None


def _focal_lengths(data: Data) -> Iterator[float]:
    """Yields the values of `KEY` in a file."""
    whole = 0, len(data)
    of_track = boxes_at(data, *whole, b'moov', b'trak', b'meta')
    for first, last in chain(boxes_at(data, *whole, b'moov', b'meta'), of_track):
        # In MP4 files a version precedes the boxes.
        first += 0 if data[first + 4 : first + 8] == b'hdlr' else 4
        inner = {name: (a, b) for name, a, b in boxes(data, first, last)}
        first, last = inner.get(b'keys', (0, 0))
        names = [data[a:b] for _, a, b in boxes(data, first + 8, last)]
        for number, a, b in boxes(data, *inner.get(b'ilst', (0, 0))):
            at = int.from_bytes(number, 'big')
            if names[at - 1 : at] == [KEY]:
                yield from (_number(data[c:d]) for _, c, d in boxes(data, a, b))


def _number(value: bytes) -> float:
    """The number in a metadata value, which consists of type, language and number."""
    kind, content = int.from_bytes(value[:4], 'big'), value[8:24]
    if kind in _FLOAT_TYPES:
        return float(struct.unpack(_FLOAT_TYPES[kind], content)[0])
    return float(content) if kind == _TEXT_TYPE else float(int.from_bytes(content, 'big'))
