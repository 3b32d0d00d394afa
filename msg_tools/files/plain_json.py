"""Reads untrusted JSON, after estimating the memory that its values need."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.error_line import error_line

MAX_MEMORY_BYTES = 700_000_000  # maximum memory of the text and its values, bytes
# Memory per character that starts a Python object (list, dictionary, number or string), bytes.
_BYTES_PER_VALUE = {b'[': 104, b'{': 210, b',': 24, b'"': 32}


def read_plain_json(path: str | Path, largest: int) -> Any:
    """Reads the JSON value in a file.

    Args:
        largest: maximum size of the file, bytes.

    Raises:
        ValueError: the file can not be read or is too large; or see `load_plain_json`.
    """
    return load_plain_json(read_bytes(path, largest))


def load_plain_json(content: bytes | str) -> Any:
    """Parses the JSON value in a text.

    Raises:
        ValueError: the text is not JSON, is nested too deeply, or needs too much memory.
    """
    text = content.encode('utf-8', 'surrogatepass') if isinstance(content, str) else content
    needed = len(text) * (2 if text.isascii() else 5)
    needed += sum(text.count(mark) * size for mark, size in _BYTES_PER_VALUE.items())
    if needed > MAX_MEMORY_BYTES:
        raise ValueError(
            f'JSON whose values take {needed} bytes, wanted at most {MAX_MEMORY_BYTES}'
        )
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError('not JSON (nested too deep)') from error
    except ValueError as error:
        raise ValueError(f'not JSON ({error_line(error)})') from error
