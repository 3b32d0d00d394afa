"""Reads archives of plain arrays (.npz) from outside, up to an agreed size.

Nothing is unpickled. A compressed archive could expand to any size, and the header of an array
could claim any size: both are checked before memory is allocated. Arrays of objects are refused, or
read by `plain_pickle`.
"""

from __future__ import annotations

import math
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as array_format
from numpy.typing import NDArray

from msg_tools.files.error_line import error_line
from msg_tools.files.plain_pickle import read_plain_pickle

# Bytes of all arrays of an archive together.
LARGEST_ARCHIVE = 2**31
_MOST_ARRAYS = 10_000
# Exceptions that damaged archives lead to, besides OSError and ValueError.
_FAULTS = (
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
    tokenize.TokenError,  # numpy reads the heads of old versions as Python
)


def read_archive(
    path: str | Path, largest: int = LARGEST_ARCHIVE, *, with_objects: bool = False
) -> dict[str, NDArray[Any]]:
    """The arrays of an archive by name.

    Args:
        largest: bytes that they may have together.
        with_objects: whether arrays of plain data (`read_plain_pickle`) are read too.

    Raises:
        OSError: a file that can not be read.
        ValueError: no archive, a damaged one, one with objects in it, or one that is too large; one
            line, without the path.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickles = _check_sizes(archive, largest)
            if pickles and not with_objects:
                raise ValueError(f'the array {next(iter(pickles))} holds Python objects')
            plain = {
                name.removesuffix('.npy'): read_plain_pickle(archive.read(name)[start:])
                for name, start in pickles.items()
            }
        with np.load(path, allow_pickle=False) as content:
            return plain | {name: content[name] for name in content.files if name not in plain}
    except _FAULTS as fault:
        raise ValueError(error_line(fault)) from fault


def _check_sizes(archive: zipfile.ZipFile, largest: int) -> dict[str, int]:
    """Raises ValueError if arrays are too large; where the pickles of arrays of objects begin."""
    members = archive.infolist()
    total = sum(member.file_size for member in members)
    if total > largest or len(members) > _MOST_ARRAYS:
        raise ValueError(
            f'its {len(members)} arrays have {total} bytes, wanted at most {_MOST_ARRAYS} arrays '
            f'and {largest} bytes'
        )
    pickles = {}
    for name, claimed, there, start in _claims(archive, members):
        if claimed is None:
            pickles[name] = start
        elif claimed > there:
            raise ValueError(f'the array {name} claims {claimed} bytes, but has {there}')
    return pickles


def _claims(
    archive: zipfile.ZipFile, members: list[zipfile.ZipInfo]
) -> Iterator[tuple[str, int | None, int, int]]:
    """Name, claimed size (None: of objects), size and length of the header of each, bytes."""
    for member in members:
        with archive.open(member) as file:
            version = array_format.read_magic(file)
            if version == (1, 0):
                shape, _, dtype = array_format.read_array_header_1_0(file)
            elif version == (2, 0):
                shape, _, dtype = array_format.read_array_header_2_0(file)
            else:
                raise ValueError(f'the array {member.filename} has the version {version}')
            claimed = None if dtype.hasobject else math.prod(shape) * dtype.itemsize
            yield member.filename, claimed, member.file_size, file.tell()
