"""Pictures that parameters name."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

_LARGEST_FILE = 2**28  # bytes


def read_picture(file: str) -> NDArray[np.uint8]:
    """A picture (H, W, 3), BGR.

    Raises:
        ValueError: there is none in the file.
    """
    path = Path(file)
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ValueError(f'{path}: {path.stat().st_size} bytes, wanted a picture')
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise ValueError(f'{path}: can not be read ({error.strerror})') from error
    picture = None
    if data.size:
        try:
            picture = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        except cv2.error:
            picture = None
    if picture is None:
        raise ValueError(f'{path}: not a picture that OpenCV reads, wanted png or jpeg for example')
    return np.asarray(picture, dtype=np.uint8)
