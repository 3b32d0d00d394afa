"""Opens untrusted videos, but only containers that include all images, up to a maximum size.

FFmpeg also reads lists of files or URLs, and image sequences given by a name pattern; both are
refused.
"""

from __future__ import annotations

import re
import struct
from itertools import chain
from pathlib import Path

import cv2

from msg_tools.files.mp4_boxes import boxes_at, mapped

MAX_PIXELS = 2**26  # maximum size of an image, pixels
# MP4 and QuickTime, AVI, Matroska and WebM, Ogg, Flash, GIF, ASF, MPEG and H.264, YUV4MPEG2, IVF,
# MPEG transport streams, sequences of JPEG images, DV, MXF.
_CONTAINERS = re.compile(
    rb'.{4}(ftyp|moov|mdat|free|skip|wide|pnot|uuid)|RIFF.{4}AVI |\x1aE\xdf\xa3|OggS|FLV|GIF8'
    rb'|0&\xb2u|\x00?\x00\x00\x01|YUV4MPEG2|DKIF|G.{187}G|.{4}G.{191}G|\xff\xd8\xff|\x1f\x07\x00'
    rb'|\x06\x0e\x2b\x34',
    re.DOTALL,
)


def open_video(path: Path) -> cv2.VideoCapture:
    """Opens a video whose images are in the file itself.

    Raises:
        OSError: the file can not be read.
        ValueError: unsupported format, damaged file, or images that are too large.
    """
    with mapped(path) as data:
        # Tables of equal-sized images, and tables of fragments, can list images that have no bytes
        # in the file.
        tables = boxes_at(data, 0, len(data), b'moov', b'trak', b'mdia', b'minf', b'stbl', b'stsz')
        runs = boxes_at(data, 0, len(data), b'moof', b'traf', b'trun')
        counts = chain(((at + 8, end) for at, end in tables), ((at + 4, end) for at, end in runs))
        images = sum(struct.unpack_from('>I', data, at)[0] for at, end in counts if at + 4 <= end)
        known = _CONTAINERS.match(data) and '%' not in path.name and images <= len(data)
    # An absolute path, because a relative name with a colon would be taken for a protocol.
    capture = cv2.VideoCapture(str(path.absolute())) if known else cv2.VideoCapture()
    if not capture.isOpened():
        raise ValueError(
            f'{path} is not a video that OpenCV can read: it is damaged or incomplete, or in a '
            'format that this OpenCV does not know; convert it to .mp4'
        )
    check_size(capture, path)
    return capture


def check_size(capture: cv2.VideoCapture, path: Path) -> None:
    """Raises ValueError if the current image of a video is too large."""
    width, height = (capture.get(x) for x in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width * height > MAX_PIXELS:
        raise ValueError(
            f'{path} has images of {width:.0f}x{height:.0f} pixels, the limit is {MAX_PIXELS}'
        )
