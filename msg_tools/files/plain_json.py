"""Reads JSON from outside: the memory that its values will take is estimated first."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.error_line import error_line

LARGEST = 700_000_000  # bytes that the text and its values may take
# What Python takes for the list, the dictionary, the number or the text that a character begins.
_TAKES = {b'[': 104, b'{': 210, b',': 24, b'"': 32}


def read_plain_json(path: str | Path, largest: int) -> Any:
    """The value in a file.

    Args:
        largest: bytes that it may have.

    Raises:
        ValueError: a file that can not be read or is larger, or see `load_plain_json`.
    """
    return load_plain_json(read_bytes(path, largest))


def load_plain_json(content: bytes | str) -> Any:
    """The value that a text holds.

    Raises:
        ValueError: not JSON, nested too deep, or of more values than memory may hold; one line.
    """
    text = content.encode('utf-8', 'surrogatepass') if isinstance(content, str) else content
    needed = len(text) * (2 if text.isascii() else 5)
    needed += sum(text.count(mark) * size for mark, size in _TAKES.items())
    if needed > LARGEST:
        raise ValueError(f'JSON whose values take {needed} bytes, wanted at most {LARGEST}')
    try:
        return json.loads(text)
    except RecursionError as error:
        raise ValueError('not JSON (nested too deep)') from error
    except ValueError as error:
        raise ValueError(f'not JSON ({error_line(error)})') from error
