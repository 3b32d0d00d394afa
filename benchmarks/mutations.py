"""Damaged messages and files, made from valid ones."""

from __future__ import annotations

import struct

import numpy as np

# Numbers that often break code, as stored in CDR.
_INTEGERS = (0, 1, 2, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1)
_FLOATS = (0.0, -0.0, -1.0, 1e-320, 1e300, -1e300, float('inf'), float('-inf'), float('nan'))
WORDS = [struct.pack('<I', x) for x in _INTEGERS] + [struct.pack('<d', x) for x in _FLOATS]
# Size of the head with lengths, timestamps and names, where damage is most effective, bytes.
_HEAD = 256
_MOST_CHANGES = 4
# Probabilities of the numbers and kinds of damage; kinds except bits and words prevent reading.
_COUNTS = (0.6, 0.2, 0.1, 0.1)
_KINDS = (0.35, 0.35, 0.06, 0.06, 0.06, 0.06, 0.06)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes with up to four kinds of damage: bits, words, cut or doubled pieces, cut ends."""
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
