"""Reads untrusted message definitions in the .msg language of ROS 2.

Only names and types of fields are read, because CDR needs nothing else; constants, defaults and
comments are skipped. The time is linear in the length of the text. Definitions that are too large
are refused before code is generated from them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.serde.utils import SIZEMAP

# Limits of a definition: number of characters, fields, levels of nesting, bytes in fixed arrays,
# and strings or messages in fixed arrays (code is generated for each).
MAX_BYTES, MAX_FIELDS, MAX_LEVELS, MAX_SIZE, MAX_UNROLLED = 2**16, 1000, 20, 800_000, 250

# Types by name: name and description of each field, as in `rosbags`.
Types = dict[str, list[tuple[str, Any]]]

_NAME = r'[A-Za-z][A-Za-z0-9_]*'
_TYPE_NAME = re.compile(rf'{_NAME}(/{_NAME})+')
_MSG_FIELD = re.compile(
    rf'((?:{_NAME}/){{0,2}}{_NAME})(?:<=([0-9]{{1,18}}))?(?:\[(<=)?([0-9]{{0,18}})\])?[ \t]+'
    rf'({_NAME})[ \t]*(=?)'
)
# The field that ROS 2 adds to a message without fields.
_NO_FIELDS = 'structure_needs_at_least_one_member', (Nodetype.BASE, ('uint8', 0))
_ALIASES = {
    'time': 'builtin_interfaces/msg/Time',
    'duration': 'builtin_interfaces/msg/Duration',
    'Header': 'std_msgs/msg/Header',
}


def types_of_definition(text: str, msgtype: str) -> Types:
    """The types in a definition, including the nested types that follow it.

    Args:
        msgtype: name of the type, with its package.

    Raises:
        ValueError: the text is too long or invalid; the error message is one line.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f'its definition has more than {MAX_BYTES} characters')
    types: Types = {}
    fields = types[msgtype] = []
    for number, line in enumerate(map(str.strip, text.split('\n')), 1):
        if line.startswith('MSG: '):
            msgtype = _full_name(line[5:].strip(), msgtype)
            fields = types[msgtype] = []
        elif line.strip('=') and line[0] not in '#@':
            match = _MSG_FIELD.match(line)
            if match is None:
                raise ValueError(f'line {number} of its definition is no field')
            kind, longest, bounded, count, name, constant = match.groups()
            if not constant:
                fields.append((name, _described(kind, msgtype, longest, bounded, count)))
    return {name: fields or [_NO_FIELDS] for name, fields in types.items()}


def check_types(types: Types, known: Mapping[str, Any]) -> None:
    """Raises ValueError (one line) if types are too large or can not be used.

    Args:
        known: types of nested fields, by name; the second item of each type lists its fields.
    """
    fields = [kind for each in types.values() for _, kind in each]
    if len(types) + len(fields) > MAX_FIELDS:
        raise ValueError(f'its definition has more than {MAX_FIELDS} fields')
    arrays = [detail for kind, detail in fields if kind == Nodetype.ARRAY]
    if not all(count for _, count in arrays):
        raise ValueError('its definition has an array of length 0')
    if sum(count for (_, detail), count in arrays if detail[0] not in SIZEMAP) > MAX_UNROLLED:
        raise ValueError(f'its definition has more than {MAX_UNROLLED} messages in fixed arrays')
    extents: dict[str, Extent] = {}
    everything = {**known, **{name: ((), types[name]) for name in types}}
    for name in types:
        if not _TYPE_NAME.fullmatch(name):
            raise ValueError(f'its definition has a type named {name[:40]!r}')
        if extent_of((Nodetype.NAME, name), everything, extents).size > MAX_SIZE:
            raise ValueError(f'its definition has fixed arrays of more than {MAX_SIZE} bytes')


class Extent(NamedTuple):
    """Minimum size of a field, which it has if all its sequences are empty.

    Attributes:
        values: number of Python objects; an array of numbers is one object.
        size: size, bytes.
        density: maximum number of values per byte in the sequences of the field.
        levels: number of levels of nested messages.
    """

    values: int
    size: int
    density: float = 0.0
    levels: int = 0


def extent_of(
    description: Any, types: Mapping[str, Any], extents: dict[str, Extent], level: int = 0
) -> Extent:
    """Computes the extent of a field, given as `rosbags` describes it.

    Args:
        types: types by name; the second item of each type lists its fields.
        extents: known extents by type; new extents are added.
        level: number of messages in which the field is nested.

    Raises:
        ValueError: a type is unknown, or is nested too deeply, for example in itself.
    """
    kind, detail = description
    if kind == Nodetype.BASE:
        return Extent(1, SIZEMAP.get(detail[0], 5))
    if kind == Nodetype.NAME:
        if detail not in extents and level < MAX_LEVELS:
            if detail not in types:
                raise ValueError(f'{detail[:40]} is not defined')
            fields = [extent_of(each, types, extents, level + 1) for _, each in types[detail][1]]
            columns = zip(*fields, strict=True)
            values, sizes, densities, levels = (list(each) for each in columns)
            extents[detail] = Extent(1 + sum(values), sum(sizes), max(densities), 1 + max(levels))
        if detail not in extents or level + extents[detail].levels > MAX_LEVELS:
            raise ValueError(f'its definition is nested deeper than {MAX_LEVELS} levels')
        return extents[detail]
    element, count = detail
    one = extent_of(element, types, extents, level)
    number = element[1][0] in SIZEMAP
    if kind == Nodetype.ARRAY:
        made = 1 if number else 1 + count * one.values
        return one._replace(values=made, size=count * one.size)
    density = 0.0 if number else max(one.density, one.values / one.size)
    return Extent(1, 4, density, one.levels)


def _full_name(name: str, owner: str) -> str:
    """Full name, as in `rosbags`, of a type that a field of another type refers to."""
    *package, last = _ALIASES.get(name, name).split('/')
    if not package:
        return f'{owner.rpartition("/")[0]}/{last}'
    middle = [] if {'msg', 'action'} & set(package) else ['msg']
    return '/'.join([*package, *middle, last])


def _described(
    kind: str, owner: str, longest: str | None, bounded: str | None, count: str | None
) -> Any:
    """Description of a field of a type.

    Args:
        longest: maximum number of characters of a string.
        bounded: whether `count` is the maximum length of a sequence.
        count: length of an array; empty for a sequence, None for a single value.
    """
    if kind == 'string' or kind in SIZEMAP:
        one: Any = Nodetype.BASE, (kind, int(longest or 0))
    else:
        one = Nodetype.NAME, _full_name(kind, owner)
    if count is None:
        return one
    sequence = bounded or not count
    return Nodetype.SEQUENCE if sequence else Nodetype.ARRAY, (one, int(count or 0))
