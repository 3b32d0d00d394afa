"""Pictures that parameters name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from msg_tools.messages.images import ImageError, decode_picture

_LARGEST_FILE = 2**28  # bytes


def read_picture(file: str) -> NDArray[np.uint8]:
    """A picture (H, W, 3), BGR, of a PNG or JPEG file.

    Raises:
        ValueError: there is none in the file, or one that is too large.
    """
    path = Path(file)
    try:
        size = path.stat().st_size
        if size > _LARGEST_FILE:
            raise ValueError(f'{path}: {size} bytes, the limit for a picture is {_LARGEST_FILE}')
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f'{path}: can not be read ({error.strerror})') from error
    try:
        return decode_picture(content)
    except ImageError as error:
        raise ValueError(f'{path}: not a picture ({error})') from error
