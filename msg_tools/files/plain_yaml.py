"""Reads handwritten YAML: plain data without aliases, of limited depth and size.

The loader knows no Python tags. Aliases could expand a short file to more data than fits into
memory; ROS does not accept them in its parameter files either.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from msg_tools.files.bounded_file import read_bytes
from msg_tools.files.error_line import error_line

# Maximum number of nodes; a parser in pure Python takes 50 us per node.
MAX_NODES = 20_000
_MAX_DEPTH = 50
_MAX_NUMBER_LENGTH = 100  # characters; parsing of numbers in base 60 takes quadratic time
# Exceptions of constructors for `!!bool x`, `!!int ""`, or `!!timestamp x`.
_YAML_ERRORS = (
    yaml.YAMLError,
    ValueError,
    ArithmeticError,
    RecursionError,
    LookupError,
    AttributeError,
)


class _PlainLoader(yaml.SafeLoader):
    _depth = _nodes = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError(f'line {self._line()}: an alias (*), wanted plain values')
        if self._depth == _MAX_DEPTH:
            raise yaml.YAMLError(f'line {self._line()}: nested deeper than {_MAX_DEPTH} levels')
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise yaml.YAMLError(f'line {self._line()}: more than {MAX_NODES} values')
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        kind = '' if node is None else node.tag.rpartition(':')[2]
        if node is not None and kind in ('int', 'float') and len(node.value) > _MAX_NUMBER_LENGTH:
            raise yaml.YAMLError(f'a number of {len(node.value)} characters')
        return node

    def _line(self) -> int:
        event: yaml.Event = self.peek_event()  # type: ignore[no-untyped-call]
        mark = event.start_mark
        return 0 if mark is None else int(mark.line) + 1


def read_plain_yaml(path: str | Path, largest: int) -> Any:
    """Reads the YAML document in a file.

    Args:
        largest: maximum size of the file, bytes.

    Raises:
        ValueError: the file can not be read, is too large, or is not plain YAML; the message is one
            line without the path.
    """
    content = read_bytes(path, largest)
    try:
        return load_plain_yaml(content.decode('utf-8'))
    except ValueError as error:
        raise ValueError(f'not YAML ({error})') from error


def load_plain_yaml(text: str) -> Any:
    """Parses the YAML document in a text.

    Raises:
        ValueError: the text is not plain YAML; the error message is one line.
    """
    try:
        return yaml.load(text, Loader=_PlainLoader)
    except _YAML_ERRORS as error:
        raise ValueError(error_line(error)) from error
