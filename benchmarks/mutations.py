"""Messages and files that nobody would write: valid ones with damage, and ones made up by type."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from hypothesis import strategies
from hypothesis.strategies import SearchStrategy
from rosbags.interfaces import Nodetype

from msg_tools import RosbagsMessages
from msg_tools.messages.message_types import typestore

# Numbers at which code breaks, as they stand in CDR.
_INTEGERS = (0, 1, 2, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1)
_FLOATS = (0.0, -0.0, -1.0, 1e-320, 1e300, -1e300, float('inf'), float('-inf'), float('nan'))
WORDS = [struct.pack('<I', x) for x in _INTEGERS] + [struct.pack('<d', x) for x in _FLOATS]
# Damage is most telling where lengths, stamps and names are.
_HEAD = 256
_MOST_CHANGES = 4
# How often each kind of damage: most other than of bits and words can not even be read.
_COUNTS = (0.6, 0.2, 0.1, 0.1)
_KINDS = (0.35, 0.35, 0.06, 0.06, 0.06, 0.06, 0.06)

_LIMITS = {
    'int8': (-(2**7), 2**7 - 1), 'uint8': (0, 2**8 - 1), 'byte': (0, 2**8 - 1),
    'char': (0, 2**8 - 1), 'octet': (0, 2**8 - 1),
    'int16': (-(2**15), 2**15 - 1), 'uint16': (0, 2**16 - 1),
    'int32': (-(2**31), 2**31 - 1), 'uint32': (0, 2**32 - 1),
    'int64': (-(2**63), 2**63 - 1), 'uint64': (0, 2**64 - 1),
}  # fmt: skip
_SHORT = 6


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes with up to four kinds of damage: bits, words, pieces that are cut or doubled, ends."""
    content = bytearray(data)
    for _ in range(int(rng.choice(_MOST_CHANGES, p=_COUNTS)) + 1):
        reach = min(len(content), _HEAD) if rng.random() < 0.5 else len(content)
        at = int(rng.integers(0, reach + 1))
        length = int(rng.integers(1, 33))
        kind = int(rng.choice(len(_KINDS), p=_KINDS))
        if kind == 0 and at < len(content):
            content[at] ^= 1 << int(rng.integers(0, 8))
        elif kind == 1:
            word = WORDS[int(rng.integers(0, len(WORDS)))]
            at -= at % 4
            content[at : at + len(word)] = word
        elif kind == 2:
            del content[at : at + length]
        elif kind == 3:
            content[at:at] = rng.bytes(length)
        elif kind == 4:
            content[at:at] = content[at : at + length]
        elif kind == 5:
            del content[at:]
        else:
            content[at : at + length] = rng.bytes(length)
    return bytes(content)


def messages_of(msgtype: str, words: tuple[str, ...] = ()) -> SearchStrategy[Any]:
    """Messages of a type whose fields are anything that the type allows.

    Args:
        msgtype: for example 'hmt_msgs/msg/PoseMixture'.
        words: that texts are made of as well, such as names that mean something.
    """
    factory = RosbagsMessages()
    _, fields = typestore().fielddefs[msgtype]
    parts = {name: _values(kind, words) for name, kind in fields}
    return strategies.fixed_dictionaries(parts).map(
        lambda values: factory.create(msgtype, **values)
    )


def _values(kind: Any, words: tuple[str, ...]) -> SearchStrategy[Any]:
    node, what = kind
    if node == Nodetype.BASE:
        return _scalars(what[0], words)
    if node == Nodetype.NAME:
        return messages_of(what, words)
    inner, length = what
    least, most = (length, length) if node == Nodetype.ARRAY else (0, _SHORT)
    if inner[0] == Nodetype.BASE and inner[1][0] not in ('string', 'wstring'):
        dtype = np.dtype({'byte': 'u1', 'char': 'u1', 'octet': 'u1'}.get(inner[1][0], inner[1][0]))
        lists = strategies.lists(_scalars(inner[1][0], words), min_size=least, max_size=most)
        return lists.map(lambda values: np.array(values, dtype=dtype))
    return strategies.lists(_values(inner, words), min_size=least, max_size=most)


def _scalars(name: str, words: tuple[str, ...]) -> SearchStrategy[Any]:
    if name in ('string', 'wstring'):
        known = strategies.sampled_from(words) if words else strategies.nothing()
        # Surrogates are no UTF-8, and a zero ends a text.
        letters = strategies.characters(exclude_categories=['Cs'], exclude_characters='\0')
        return known | strategies.text(letters, max_size=12)
    if name == 'bool':
        return strategies.booleans()
    if name.startswith('float'):
        width = 32 if name == 'float32' else 64
        return strategies.floats(width=width) | strategies.floats(-10.0, 10.0, width=width)
    low, high = _LIMITS[name]
    return strategies.integers(low, high) | strategies.integers(max(low, 0), min(high, 100))
