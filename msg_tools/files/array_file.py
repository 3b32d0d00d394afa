"""Reads untrusted archives of plain arrays (.npz) up to a maximum size.

Nothing is unpickled. A compressed archive could expand to any size, and the header of an array
could claim any size; both are checked before memory is allocated. Arrays of objects are refused.
"""

from __future__ import annotations

import math
import os
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as array_format
from numpy.typing import NDArray

from msg_tools.files.bounded_file import open_regular
from msg_tools.files.budget import Budget
from msg_tools.files.error_line import error_line

# Maximum total size of the arrays of an archive, bytes.
MAX_ARCHIVE_BYTES = 2**29
_MAX_ARRAYS = 10_000
_KINDS = 'biufSU'
_MIN_VALUE_BYTES = 4  # smaller numbers count as this size, bytes
_MAX_EMPTY_SIDE = 10**6  # maximum length of an axis of an array without data
_HEADER_READERS = {
    (1, 0): array_format.read_array_header_1_0,
    (2, 0): array_format.read_array_header_2_0,
}
# Exceptions from damaged archives, in addition to OSError and ValueError.
_ARCHIVE_ERRORS = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    struct.error,
    KeyError,
    EOFError,
    AttributeError,
    NotImplementedError,
    RuntimeError,
    MemoryError,
    SyntaxError,
    TypeError,
    OverflowError,
    tokenize.TokenError,  # numpy parses headers of old versions as Python
)


def read_archive(path: str | Path, largest: int = MAX_ARCHIVE_BYTES) -> dict[str, NDArray[Any]]:
    """Reads the arrays of an archive into a dictionary keyed by name.

    Args:
        largest: maximum total size of the arrays, bytes.

    Raises:
        OSError: the file can not be read.
        ValueError: the file is not an archive, is damaged or too large, or contains objects; the
            message is one line without the path.
    """
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            total = sum(member.file_size for member in members)
            if total > largest or len(members) > _MAX_ARRAYS:
                raise ValueError(
                    f'its {len(members)} arrays have {total} bytes, wanted at most {_MAX_ARRAYS} '
                    f'arrays and {largest} bytes'
                )
            Budget(os.fstat(file.fileno()).st_size).spend(unpacked=total)
            return {
                member.filename.removesuffix('.npy'): _array(archive, member, largest)
                for member in members
            }
    except (ValueError, *_ARCHIVE_ERRORS) as fault:
        raise ValueError(error_line(fault)) from fault


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo, largest: int) -> NDArray[Any]:
    """Reads an array of an archive, after comparing its header with its number of bytes."""
    name, there = member.filename, member.file_size
    with archive.open(member) as file:
        read_head = _HEADER_READERS.get(array_format.read_magic(file))
        if read_head is None:
            raise ValueError(f'the array {name} has an unknown version')
        shape, _, dtype = read_head(file)
        if dtype.kind not in _KINDS:
            raise ValueError(f'the array {name} holds {str(dtype)[:40]}, wanted numbers or texts')
        # Callers convert numbers of one byte to larger types.
        claimed = math.prod(shape) * max(dtype.itemsize, _MIN_VALUE_BYTES)
        if math.prod(shape) * dtype.itemsize > there or claimed > largest:
            raise ValueError(f'the array {name} claims {claimed} bytes, but has {there}')
        if max(shape, default=0) > max(there, _MAX_EMPTY_SIDE):
            raise ValueError(f'the array {name} has shape {str(shape)[:40]}, but {there} bytes')
        file.seek(0)
        return np.asarray(array_format.read_array(file, allow_pickle=False))
