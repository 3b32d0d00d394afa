"""Reads message definitions from outside, in the language .msg of ROS 2.

Only what CDR needs is read: names and types of fields. Constants, defaults and comments are passed
over. The time is linear in the length of the text, and what is too large is refused before code is
generated from it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.serde.utils import SIZEMAP

# A definition may have so many characters, fields, levels of nesting, bytes in fixed arrays of
# numbers, and strings or messages in fixed arrays, for each of which code is generated.
MAX_BYTES, MAX_FIELDS, MAX_LEVELS, MAX_SIZE, MAX_UNROLLED = 2**16, 1000, 20, 800_000, 250

# Types by name: name and description of each field, as `rosbags` has them.
Types = dict[str, list[tuple[str, Any]]]

_NAME = r'[A-Za-z][A-Za-z0-9_]*'
_TYPE_NAME = re.compile(rf'{_NAME}(/{_NAME})+')
_MSG_FIELD = re.compile(
    rf'((?:{_NAME}/){{0,2}}{_NAME})(?:<=([0-9]{{1,18}}))?(?:\[(<=)?([0-9]{{0,18}})\])?[ \t]+'
    rf'({_NAME})[ \t]*(=?)'
)
# The field that ROS 2 gives a message without fields.
_NO_FIELDS = 'structure_needs_at_least_one_member', (Nodetype.BASE, ('uint8', 0))
_ALIASES = {
    'time': 'builtin_interfaces/msg/Time',
    'duration': 'builtin_interfaces/msg/Duration',
    'Header': 'std_msgs/msg/Header',
}


def types_of_definition(text: str, msgtype: str) -> Types:
    """Types of a definition, with those of the nested types that stand behind it.

    Args:
        msgtype: with its package.

    Raises:
        ValueError: the text is too long, or can not be understood; one line.
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
    """Raises ValueError where types are too large, or can not be used; one line.

    Args:
        known: types that they may use, by name; the fields of each come second.
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
    """What a field takes at least, with all its sequences empty.

    Attributes:
        values: for which objects are made; an array of numbers is one.
        size: bytes.
        density: values for a byte, at most, in its sequences.
        levels: of messages in messages.
    """

    values: int
    size: int
    density: float = 0.0
    levels: int = 0


def extent_of(
    description: Any, types: Mapping[str, Any], extents: dict[str, Extent], level: int = 0
) -> Extent:
    """Extent of a field, given as `rosbags` describes it.

    Args:
        types: by name; the fields of each come second.
        extents: of types, as far as they are known; more are added.
        level: of messages around the field.

    Raises:
        ValueError: a type that is not known, or that is nested too deeply, as in itself.
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
    """Name of a type in full, as `rosbags` has it, where it stands in a field of another type."""
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
        longest: number of characters that a string may have.
        bounded: whether the count is that of the longest sequence.
        count: length of an array; empty: a sequence; None: a single value.
    """
    if kind == 'string' or kind in SIZEMAP:
        one: Any = Nodetype.BASE, (kind, int(longest or 0))
    else:
        one = Nodetype.NAME, _full_name(kind, owner)
    if count is None:
        return one
    sequence = bounded or not count
    return Nodetype.SEQUENCE if sequence else Nodetype.ARRAY, (one, int(count or 0))
