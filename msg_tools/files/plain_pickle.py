"""Reads pickles from outside as plain data: nothing in them is imported or called.

`pickletools` decodes the opcodes, and the few that build lists, dictionaries, texts, numbers and
numpy arrays are followed here. Sizes are compared with the bytes that are there.
"""

from __future__ import annotations

import math
import pickletools
import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Opcodes of a pickle; one of plain arrays has a few hundred.
MOST_OPCODES = 1_000_000
_VALUES = re.compile(
    r'BININT[12]?|LONG[14]|BINFLOAT|(SHORT_)?BINUNICODE|BINUNICODE8|(SHORT_)?BINBYTES|BINBYTES8'
    r'|BYTEARRAY8|(SHORT_)?BINSTRING'
)
_CONSTANTS = {'NONE': None, 'NEWTRUE': True, 'NEWFALSE': False, 'EMPTY_TUPLE': ()}
_CONTAINERS: dict[str, type[list[Any]] | type[dict[Any, Any]]] = {
    'EMPTY_LIST': list,
    'EMPTY_DICT': dict,
}
_TUPLES = {'TUPLE1': 1, 'TUPLE2': 2, 'TUPLE3': 3}
_PUT, _GET = ('BINPUT', 'LONG_BINPUT', 'MEMOIZE'), ('BINGET', 'LONG_BINGET')
_GLOBAL = re.compile(
    r'numpy(?:\._?core\.(?:multiarray|numeric))? (_reconstruct|ndarray|dtype|scalar|_frombuffer)'
    r'|_codecs (encode)'
)
_TYPE = re.compile(r'[<>=|]?[biufOUS]\d{0,6}')


@dataclass
class _Global:
    """A name of numpy that rebuilds something."""

    name: str


@dataclass
class _Type:
    """A type of arrays, whose byte order comes later."""

    code: str

    @property
    def built(self) -> np.dtype[Any]:
        if not _TYPE.fullmatch(self.code):
            raise ValueError(f'arrays of type {self.code[:20]!r}, wanted numbers or text')
        return np.dtype(self.code)


@dataclass
class _Array:
    """An array, whose content comes later."""

    built: NDArray[Any] = field(default_factory=lambda: np.zeros(0))


def read_plain_pickle(content: bytes) -> Any:
    """The data in a pickle: dict, list, tuple, text, bytes, numbers, None and numpy arrays.

    Lists may hold themselves, as those of pickles may: follow them to a fixed depth.

    Raises:
        ValueError: damaged, or with anything else in it; one line.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
            if count > MOST_OPCODES:
                raise ValueError(f'the pickle has more than {MOST_OPCODES} opcodes')
            if opcode.name == 'STOP':
                return _built(stack.pop())
            _follow(opcode.name, argument, stack, marks, memo)
    except (IndexError, KeyError, TypeError, AttributeError, OverflowError) as fault:
        raise ValueError('the pickle is damaged') from fault
    raise ValueError('the pickle has no end')


def _follow(
    name: str, argument: Any, stack: list[Any], marks: list[int], memo: dict[int, Any]
) -> None:
    """Carries out one opcode."""

    def above_mark() -> list[Any]:
        at = marks.pop()
        items = [_built(x) for x in stack[at:]]
        del stack[at:]
        return items

    if _VALUES.fullmatch(name):
        stack.append(argument)
    elif name in _CONSTANTS:
        stack.append(_CONSTANTS[name])
    elif name in _CONTAINERS:
        stack.append(_CONTAINERS[name]())
    elif name in _PUT:
        memo[len(memo) if argument is None else argument] = stack[-1]
    elif name in _GET:
        stack.append(memo[argument])
    elif name == 'MARK':
        marks.append(len(stack))
    elif name in ('APPENDS', 'APPEND'):
        items = [_built(stack.pop())] if name == 'APPEND' else above_mark()
        list.extend(stack[-1], items)
    elif name in ('SETITEMS', 'SETITEM'):
        if name == 'SETITEM':
            marks.append(len(stack) - 2)
        items = above_mark()
        if not all(isinstance(x, (str, bytes, int, float)) for x in items[::2]):
            raise ValueError('the pickle has keys that are neither texts nor numbers')
        dict.update(stack[-1], zip(items[::2], items[1::2], strict=True))
    elif name in _TUPLES or name == 'TUPLE':
        if name in _TUPLES:
            marks.append(len(stack) - _TUPLES[name])
        stack.append(tuple(above_mark()))
    elif name in ('GLOBAL', 'STACK_GLOBAL'):
        text = argument or ' '.join((stack.pop(-2), stack.pop()))
        known = _GLOBAL.fullmatch(text)
        if known is None:
            raise ValueError(f'the pickle wants to use {text[:60]!r}, which is not plain data')
        stack.append(_Global(known[1] or known[2]))
    elif name == 'REDUCE':
        arguments = stack.pop()
        stack.append(_called(stack.pop().name, *arguments))
    elif name == 'BUILD':
        state = stack.pop()
        if isinstance(stack[-1], _Type):
            stack[-1].code = state[1] + stack[-1].code.lstrip('<>=|')
        else:
            stack[-1].built = _array(state[4], state[2], state[1], 'F' if state[3] else 'C')
    elif name not in ('PROTO', 'FRAME'):
        raise ValueError(f'the pickle has the opcode {name}, which plain data does not need')


def _called(name: str, *arguments: Any) -> Any:
    """What a function of numpy would give."""
    if name == '_reconstruct':
        return _Array()
    if name == 'dtype':
        return _Type(str(arguments[0]))
    if name == 'scalar':
        return _array(arguments[1], arguments[0], (), 'C')[()]
    if name == '_frombuffer':
        return _array(*arguments)
    if name == 'encode' and arguments[1:] == ('latin1',):
        return arguments[0].encode('latin1')
    raise ValueError(f'the pickle wants to call {name}')


def _array(content: Any, kind: Any, shape: tuple[int, ...], order: Any) -> NDArray[Any]:
    """An array of the content that is there: bytes, or a list of objects."""
    dtype = _built(kind)
    if isinstance(content, str):  # of Python 2
        content = content.encode('latin1')
    if not all(isinstance(n, int) and n >= 0 for n in shape):
        raise ValueError('the pickle has an array of a negative shape')
    objects = isinstance(content, list)
    if objects != dtype.hasobject or math.prod(shape) * (1 if objects else dtype.itemsize) != len(
        content
    ):
        raise ValueError(f'the pickle has an array of {shape} with {len(content)} bytes or objects')
    if not objects:
        return np.frombuffer(bytes(content), dtype).reshape(shape, order=order)
    flat = np.empty(len(content), dtype=object)
    for i, item in enumerate(content):
        flat[i] = item
    return flat.reshape(shape, order=order)


def _built(value: Any) -> Any:
    """An array or a type in place of what stood for it."""
    return value.built if isinstance(value, (_Array, _Type)) else value
