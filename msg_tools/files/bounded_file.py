"""Reads untrusted files up to a maximum size, with one-line error messages."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def open_regular(path: str | Path) -> Iterator[BinaryIO]:
    """Opens a regular file for reading, and never blocks on a pipe.

    Raises:
        OSError: the file can not be opened, or is a folder, a pipe or a device.
    """
    with open(path, 'rb', opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, 'a pipe or a device, wanted a file')
        yield file


def read_bytes(path: str | Path, largest: int) -> bytes:
    """Reads the content of a regular file.

    Args:
        largest: maximum size, bytes.

    Raises:
        ValueError: the file can not be read or is too large; the message is one line without the
            path.
    """
    try:
        with open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > largest:
                raise ValueError(f'{size} bytes, wanted at most {largest}')
            content = file.read(size + 1)
    except OSError as error:
        raise ValueError(f'can not be read ({error.strerror or error})') from error
    if len(content) > size:
        raise ValueError(f'can not be read (it has more than its {size} bytes)')
    return content
