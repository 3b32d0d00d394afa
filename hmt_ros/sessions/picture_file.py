"""Pictures that parameters name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from msg_tools.files.bounded_file import read_bytes
from msg_tools.messages.images import ImageError, decode_picture

_LARGEST_FILE = 2**28  # bytes


def read_picture(file: str) -> NDArray[np.uint8]:
    """A picture (H, W, 3), BGR, of a PNG or JPEG file.

    Raises:
        ValueError: there is none in the file, or one that is too large.
    """
    try:
        return decode_picture(read_bytes(file, _LARGEST_FILE))
    except ImageError as error:
        raise ValueError(f'{file}: not a picture ({error})') from error
    except ValueError as error:
        raise ValueError(f'{file}: {error}') from error
