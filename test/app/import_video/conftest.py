"""Small videos and the output files of detectors."""

import struct

import cv2
import numpy as np
import pytest

SIZE = (64, 48)  # width and height, px


def shade(number):
    """Image of a frame whose grey level encodes its number; the upper left corner is bright."""
    image = np.full((SIZE[1], SIZE[0], 3), 20 + 8 * number, np.uint8)
    image[:12, :16] = 250
    return image


def number_in(image):
    return round((float(np.median(image)) - 20) / 8)


def write_video(path, count=10, fps=25.0, image=shade):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*'mp4v'), fps, SIZE)
    assert writer.isOpened()
    for i in range(count):
        writer.write(image(i))
    writer.release()
    return path


@pytest.fixture(name='number_in')
def _number_in():
    """Function image -> number of its frame."""
    return number_in


@pytest.fixture
def video(tmp_path):
    """A video of 10 frames at 25 Hz."""
    return write_video(tmp_path / 'short.mp4')


@pytest.fixture
def folder(tmp_path):
    """A folder of 10 JPEG files, img_1 to img_10."""
    path = tmp_path / 'images'
    path.mkdir()
    for i in range(10):
        assert cv2.imwrite(str(path / f'img_{i + 1}.jpg'), shade(i))
    return path


def _with_pixel_aspect(content, across, down):
    changed = bytearray(content)
    above = [content.index(x) - 4 for x in (b'moov', b'trak', b'mdia', b'minf', b'stbl', b'stsd')]
    end = above[-1] + struct.unpack_from('>I', content, above[-1])[0]
    # The description of the images is in the box that follows the count of descriptions.
    for begin in (*above, above[-1] + 16):
        struct.pack_into('>I', changed, begin, struct.unpack_from('>I', content, begin)[0] + 16)
    changed[end:end] = struct.pack('>I4sII', 16, b'pasp', across, down)
    return bytes(changed)


@pytest.fixture
def with_pixel_aspect():
    """Function (MP4 file, width, height) -> the file with pixels of that aspect ratio."""
    return _with_pixel_aspect
