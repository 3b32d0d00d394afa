"""Files from outside, up to an agreed size, with errors of one line."""

from __future__ import annotations

import os
from pathlib import Path

_PIECE = 2**20


def read_bytes(path: str | Path, largest: int) -> bytes:
    """The content of a file.

    Args:
        path: of the file; one without a size (a pipe, a device) is read up to the limit.
        largest: bytes that it may have.

    Raises:
        ValueError: a file that can not be read, or that is larger; one line, without the path.
    """
    content = bytearray()
    try:
        with Path(path).open('rb') as file:
            size = os.fstat(file.fileno()).st_size
            if size > largest:
                raise ValueError(f'{size} bytes, wanted at most {largest}')
            while piece := file.read(_PIECE):
                content += piece
                if len(content) > largest:
                    raise ValueError(f'more than {largest} bytes')
    except OSError as error:
        raise ValueError(f'can not be read ({error.strerror or error})') from error
    return bytes(content)
