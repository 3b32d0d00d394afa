"""Reads parameter files of ROS 2 without ROS; `docs/generate.py` writes the files in `config`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from hmt_ros.sessions.declared_parameters import Value
from msg_tools.files.plain_yaml import read_plain_yaml

PARAMETERS_KEY = 'ros__parameters'
MAX_FILE_BYTES = 250_000  # bytes


def yaml_scalar(value: Value) -> str:
    """Format a value as YAML that the parser of ROS reads as the same type."""
    if isinstance(value, str):
        return "'" + value.replace("'", "''") + "'"
    if isinstance(value, list | tuple):
        return f'[{", ".join(yaml_scalar(each) for each in value)}]'
    return yaml.safe_dump(value).removesuffix('\n...\n').strip()


def read_parameter_file(path: str | Path, node: str, *, by_name: bool = False) -> dict[str, Any]:
    """Read the parameters of a node from a file, as a mapping from dotted name to value.

    Sections for other nodes are ignored; a file may also contain only parameters, without sections.

    Args:
        by_name: whether to use only sections that name the node, without sections for all nodes.

    Raises:
        ValueError: the file is not a parameter file (one-line message with the reason).
    """
    path = Path(path)
    try:
        document = read_plain_yaml(path, MAX_FILE_BYTES)
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from error
    if document is None:
        return {}
    if not isinstance(document, dict):
        raise ValueError(f'{path}: wanted parameters by name, saw {type(document).__name__}')
    sections = {
        str(key): value
        for key, value in document.items()
        if isinstance(value, dict) and PARAMETERS_KEY in value
    }
    if not sections:
        return {} if by_name else dict(_flattened(document, '', path))
    result: dict[str, Any] = {}
    for key in document:
        if str(key) not in sections:
            raise ValueError(f'{path}: section {key!r} has no {PARAMETERS_KEY}')
    # As in ROS, a section for one node overrides a section for all nodes.
    for key in sorted(sections, key=lambda key: '*' not in key):
        if key.rpartition('/')[2] in ((node,) if by_name else (node, '*', '**')):
            result.update(_flattened(sections[key][PARAMETERS_KEY] or {}, '', path))
    return result


def _flattened(values: Any, prefix: str, path: Path) -> Iterator[tuple[str, Any]]:
    if not isinstance(values, Mapping):
        raise ValueError(f'{path}: wanted parameters by name, saw {values!r}')
    for key, value in values.items():
        name = f'{prefix}{key}'
        if isinstance(value, Mapping):
            yield from _flattened(value, f'{name}.', path)
        else:
            yield name, value
