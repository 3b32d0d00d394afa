"""Reads message definitions from outside, in the languages .msg and .idl of ROS 2.

Only what CDR needs is read: names and types of fields. Constants, defaults, comments and
annotations are passed over. The time is linear in the length of the text, and what is too large is
refused before code is generated from it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from rosbags.interfaces import Nodetype

# A definition may have so many bytes, fields, values in fixed arrays, levels of nesting, and
# strings or messages in fixed arrays, for each of which code is generated.
MAX_BYTES, MAX_FIELDS, MAX_VALUES, MAX_LEVELS, MAX_UNROLLED = 2**16, 1000, 100_000, 20, 1000

# Types by name: name and description of each field, as `rosbags` has them.
Types = dict[str, list[tuple[str, Any]]]

_NAME = r'[A-Za-z][A-Za-z0-9_]*'
_TYPE_NAME = re.compile(rf'{_NAME}(/{_NAME})+')
_MSG_FIELD = re.compile(
    rf'((?:{_NAME}/){{0,2}}{_NAME})(?:<=([0-9]+))?(?:\[(<=)?([0-9]*)\])?[ \t]+'
    rf'({_NAME})[ \t]*(=?)'
)
# Stands before each of the IDL files that a bag strings together.
_IDL_HEADER = re.compile(r'^={80}\nIDL: .*\n', re.MULTILINE)
# Space, comments and strings are no tokens.
_IDL_TOKEN = re.compile(
    r'\s+|//[^\n]*|#[^\n]*|/\*.*?(?:\*/|\Z)|"(?:[^"\\]|\\.?)*(?:"|\Z)|(@?[\w:.]+|.)',
    re.DOTALL | re.ASCII,
)
_IDL_FIELD = re.compile(
    rf'(sequence < )?([\w:]+(?: [a-z]+)*?)(?: < (\w+) >)?(?:(?: , (\w+))? >)? ({_NAME})'
    r'(?: \[ (\w+) \])?',
    re.ASCII,
)
_NUMBERS = {
    *('bool', 'byte', 'char', 'float32', 'float64'),
    *(f'{sign}int{bits}' for sign in ('', 'u') for bits in (8, 16, 32, 64)),
}
# The field that ROS 2 gives a message without fields.
_NO_FIELDS = 'structure_needs_at_least_one_member', (Nodetype.BASE, ('uint8', 0))
_ALIASES = {
    'time': 'builtin_interfaces/msg/Time',
    'duration': 'builtin_interfaces/msg/Duration',
    'Header': 'std_msgs/msg/Header',
}
_IDL_NUMBERS = {
    'boolean': 'bool',
    'octet': 'byte',
    'short': 'int16',
    'long': 'int32',
    'long long': 'int64',
    'unsigned short': 'uint16',
    'unsigned long': 'uint32',
    'unsigned long long': 'uint64',
    'float': 'float32',
    'double': 'float64',
}


def types_of_definition(text: str, encoding: str, msgtype: str) -> Types:
    """Types of a definition, with those of the nested types that stand behind it.

    Args:
        encoding: 'ros2msg' or 'ros2idl'; of others nothing is read.
        msgtype: the type of a .msg definition, with its package.

    Raises:
        ValueError: the text is too long, or can not be understood; one line.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f'more than {MAX_BYTES} characters')
    types: Types = {}
    if encoding == 'ros2idl':
        types = _types_of_idl(_IDL_HEADER.sub('', text))
    elif encoding == 'ros2msg':
        types = _types_of_msg(text, msgtype)
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
    if sum(count for (_, detail), count in arrays if detail[0] not in _NUMBERS) > MAX_UNROLLED:
        raise ValueError(f'its definition has more than {MAX_UNROLLED} messages in fixed arrays')
    found: dict[str, tuple[int, int]] = {}
    everything = {**known, **{name: ((), types[name]) for name in types}}
    for name in types:
        if not _TYPE_NAME.fullmatch(name):
            raise ValueError(f'its definition has a type named {name[:40]!r}')
        _extent(name, everything, found, 1)


def _extent(
    name: str, types: Mapping[str, Any], found: dict[str, tuple[int, int]], level: int
) -> tuple[int, int]:
    """Number of values of a type whose sequences are empty, and of its levels.

    Args:
        found: those of the types so far.
        level: that the type has in another one.
    """
    if name not in types:
        raise ValueError(f'{name[:40]} is not defined')
    if name not in found and level <= MAX_LEVELS:
        values, levels = 1, 1
        for _, (kind, detail) in types[name][1]:
            array = kind in (Nodetype.ARRAY, Nodetype.SEQUENCE)
            (kind, detail), count = detail if array else ((kind, detail), 1)
            one = 1
            if kind == Nodetype.NAME:
                one, below = _extent(detail, types, found, level + 1)
                levels = max(levels, 1 + below)
            values += max(count, 1) * one
        found[name] = values, levels
    if name not in found or level + found[name][1] - 1 > MAX_LEVELS:
        raise ValueError(f'its definition is nested deeper than {MAX_LEVELS} levels')
    if found[name][0] > MAX_VALUES:
        raise ValueError(f'its definition has more than {MAX_VALUES} values in fixed arrays')
    return found[name]


def _types_of_msg(text: str, msgtype: str) -> Types:
    types: Types = {}
    fields = types[msgtype] = []
    for number, line in enumerate(map(str.strip, text.split('\n')), 1):
        if line.startswith('MSG: '):
            msgtype = _full_name(line[5:].strip(), msgtype)
            fields = types[msgtype] = []
        elif line.strip('=') and line[0] not in '#@':
            match = _MSG_FIELD.match(line)
            if match is None:
                raise ValueError(f'line {number} is no field')
            kind, longest, most, count, name, constant = match.groups()
            if not constant:
                sequence = count is not None and (most or not count)
                fields.append((name, _described(kind, msgtype, longest, count, bool(sequence))))
    return types


def _types_of_idl(text: str) -> Types:
    """Modules, structures and names of types and constants, as the generators of ROS write them."""
    types: Types = {}
    named: dict[str, Any] = {}
    lengths: dict[str, str] = {}
    scope: list[str] = []
    words: list[str] = []
    for token in _idl_tokens(text):
        if token not in '{};':
            words.append(token)
            continue
        owner = '/'.join(scope)
        if token == '{':
            if len(words) != 2 or words[0] not in ('module', 'struct'):
                raise ValueError(f'{" ".join(words)[:60]!r}')
            scope.append(words[1])
            if words[0] == 'struct':
                types['/'.join(scope)] = []
        elif words and words[0] == 'const':
            lengths[words[-3]] = words[-1]
        elif words and words[0] == 'typedef':
            name, kind = _idl_field(words[1:], f'{owner}/', named, lengths)
            named[name] = kind
        elif words and owner in types:
            types[owner].append(_idl_field(words, owner, named, lengths))
        elif words or (token == '}' and not scope):
            raise ValueError(f'{" ".join(words)[:60]!r}')
        if token == '}':
            scope.pop()
        words = []
    if words or scope:
        raise ValueError('its end is missing')
    return types


def _idl_tokens(text: str) -> Iterator[str]:
    """Words and signs of an IDL text, without annotations."""
    level, before = 0, ''
    for match in _IDL_TOKEN.finditer(text):
        token = match[1]
        if not token:
            continue
        if token == '(' and (level or before[0] == '@'):
            level += 1
        if not level and token[0] != '@':
            yield token
        if token == ')' and level:
            level -= 1
        before = token


def _idl_field(
    words: list[str], owner: str, named: Mapping[str, Any], lengths: Mapping[str, str]
) -> tuple[str, Any]:
    """Name and description of a field, or of a type that is given a name."""
    match = _IDL_FIELD.fullmatch(' '.join(words[:12]))
    if match is None or len(words) > 12:
        raise ValueError(f'{" ".join(words)[:60]!r}')
    sequence, kind, longest, most, name, count = match.groups()
    if kind in named and not sequence and not count:
        return name, named[kind]
    kind = _IDL_NUMBERS.get(kind, kind.replace('::', '/').lstrip('/'))
    count = most or '' if sequence else count
    count, longest = (lengths.get(each, each) if each else each for each in (count, longest))
    return name, _described(kind, owner, longest, count, bool(sequence))


def _full_name(name: str, owner: str) -> str:
    """Name of a type in full, as `rosbags` has it, where it stands in a field of another type."""
    *package, last = _ALIASES.get(name, name).split('/')
    if not package:
        return f'{owner.rpartition("/")[0]}/{last}'
    middle = [] if {'msg', 'action'} & set(package) else ['msg']
    return '/'.join([*package, *middle, last])


def _described(
    kind: str, owner: str, longest: str | None, count: str | None, sequence: bool
) -> Any:
    """Description of a field of a type.

    Args:
        longest: number of characters that a string may have.
        count: length of an array, or longest one of a sequence; None: a single value.
    """
    if kind == 'string' or kind in _NUMBERS:
        one: Any = Nodetype.BASE, (kind, int(longest or 0))
    else:
        one = Nodetype.NAME, _full_name(kind, owner)
    if count is None:
        return one
    return Nodetype.SEQUENCE if sequence else Nodetype.ARRAY, (one, int(count or 0))
