"""Small videos, and what detectors write."""

import cv2
import numpy as np
import pytest

SIZE = (64, 48)  # width and height, px


def shade(number):
    """Image of a frame whose grey level tells its number; the upper left corner is bright."""
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
    """Function image -> number of the frame that it is."""
    return number_in


@pytest.fixture
def video(tmp_path):
    """A video of 10 frames, 25 a second."""
    return write_video(tmp_path / 'short.mp4')


@pytest.fixture
def folder(tmp_path):
    """A folder of 10 JPEG files, img_1 to img_10."""
    path = tmp_path / 'images'
    path.mkdir()
    for i in range(10):
        assert cv2.imwrite(str(path / f'img_{i + 1}.jpg'), shade(i))
    return path
