"""Reads pickles from outside as plain data: nothing in them is imported or called.

`pickletools` decodes the opcodes, and the few that build lists, dictionaries, texts, numbers and
numpy arrays are followed here. Sizes are compared with the bytes that are there.
"""

from __future__ import annotations

import math
import pickletools
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_tools.files.budget import Budget

# Opcodes of a pickle; one of plain arrays has a few hundred.
MOST_OPCODES = 200_000
_LARGEST_SIDE = 2**40
# Beyond, Python hashes many numbers alike, and dictionaries become slow.
_LARGEST_KEY = 2**60
_VALUES = re.compile(
    r'BININT[12]?|LONG[14]|BINFLOAT|(SHORT_)?BINUNICODE|BINUNICODE8|(SHORT_)?BINBYTES|BINBYTES8'
    r'|BYTEARRAY8|(SHORT_)?BINSTRING'
)
_CONSTANTS = {'NONE': None, 'NEWTRUE': True, 'NEWFALSE': False, 'EMPTY_TUPLE': ()}
# Number of items that an opcode takes from the stack; None: all above the mark.
_TAKES = dict.fromkeys(('APPENDS', 'SETITEMS', 'TUPLE')) | {
    'APPEND': 1,
    'SETITEM': 2,
    'TUPLE1': 1,
    'TUPLE2': 2,
    'TUPLE3': 3,
}
_GLOBAL = re.compile(
    r'numpy(?:\._?core\.(?:multiarray|numeric))? (_reconstruct|ndarray|dtype|scalar|_frombuffer)'
    r'|_codecs (encode)'
)
_TYPE = re.compile(r'[<>=|]?[biufOUS]\d{0,6}')


@dataclass
class _Held:
    """A name of numpy, a type or an array, which later opcodes complete."""

    built: Any = None


def read_plain_pickle(content: bytes, budget: Budget | None = None) -> Any:
    """The data in a pickle: dict, list, tuple, text, bytes, numbers, None and numpy arrays.

    Lists may hold themselves, or another list many times: follow them to a fixed depth, and never
    ask for the text of one.

    Args:
        budget: what it may unpack to; None: that of a file of its size.

    Raises:
        ValueError: damaged, or with anything else in it; one line.
    """
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[int, Any] = {}
    budget = budget or Budget(len(content))
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
            if count > MOST_OPCODES:
                raise ValueError(f'the pickle has more than {MOST_OPCODES} opcodes')
            if opcode.name != 'STOP':
                _follow(opcode.name, argument, stack, marks, memo, budget)
        return _built(stack.pop())
    except (IndexError, KeyError, TypeError, AttributeError, OverflowError) as fault:
        raise ValueError('the pickle is damaged') from fault


def _follow(
    name: str,
    argument: Any,
    stack: list[Any],
    marks: list[int],
    memo: dict[int, Any],
    budget: Budget,
) -> None:
    """Carries out one opcode."""
    if name in _TAKES:
        count = _TAKES[name]
        at = marks.pop() if count is None else len(stack) - count
        items = [_built(x) for x in stack[at:]]
        del stack[at:]
        if name.startswith('TUPLE'):
            stack.append(tuple(items))
        elif name.startswith('APPEND'):
            list.extend(stack[-1], items)
        elif all(
            isinstance(x, (str, bytes)) or (isinstance(x, (int, float)) and abs(x) < _LARGEST_KEY)
            for x in items[::2]
        ):
            dict.update(stack[-1], zip(items[::2], items[1::2], strict=True))
        else:
            raise ValueError('the pickle has keys that are neither texts nor small numbers')
    elif _VALUES.fullmatch(name):
        stack.append(argument)
    elif name in _CONSTANTS:
        stack.append(_CONSTANTS[name])
    elif name in ('EMPTY_LIST', 'EMPTY_DICT'):
        stack.append([] if name == 'EMPTY_LIST' else {})
    elif name in ('BINPUT', 'LONG_BINPUT', 'MEMOIZE'):
        memo[len(memo) if argument is None else argument] = stack[-1]
    elif name in ('BINGET', 'LONG_BINGET'):
        stack.append(memo[argument])
    elif name == 'MARK':
        marks.append(len(stack))
    elif name in ('GLOBAL', 'STACK_GLOBAL'):
        text = argument or ' '.join((stack.pop(-2), stack.pop()))
        known = _GLOBAL.fullmatch(text)
        if known is None:
            raise ValueError(f'the pickle wants to use {text[:60]!r}, which is not plain data')
        stack.append(_Held(known[1] or known[2]))
    elif name == 'REDUCE':
        arguments = stack.pop()
        stack.append(_called(stack.pop().built, budget, *arguments))
    elif name == 'BUILD':
        state, held = stack.pop(), stack[-1]
        if isinstance(held.built, np.dtype):
            held.built = held.built.newbyteorder(state[1])
        else:
            held.built = _array(budget, state[4], state[2], state[1], 'F' if state[3] else 'C')
    elif name not in ('PROTO', 'FRAME'):
        raise ValueError(f'the pickle has the opcode {name}, which plain data does not need')


def _called(name: str, budget: Budget, *arguments: Any) -> Any:
    """What a function of numpy would give."""
    if name == '_reconstruct':
        return _Held()
    if name == 'dtype' and _TYPE.fullmatch(arguments[0]):
        return _Held(np.dtype(arguments[0]))
    if name == 'scalar':
        return _array(budget, arguments[1], arguments[0], (), 'C')[()]
    if name == '_frombuffer':
        return _array(budget, *arguments)
    if name == 'encode' and arguments[1:] == ('latin1',):
        budget.spend(unpacked=len(arguments[0]))
        return arguments[0].encode('latin1')
    raise ValueError(f'the pickle has a {name} of {str(arguments[0])[:20]!r}, wanted plain data')


def _array(
    budget: Budget, content: Any, held: _Held, shape: tuple[int, ...], order: Any
) -> NDArray[Any]:
    """An array of the content that is there: bytes, or a list of objects.

    The memo of a pickle gives the same content to many arrays, so each counts.
    """
    if not all(type(side) is int and 0 <= side < _LARGEST_SIDE for side in shape):
        raise ValueError('the pickle has an array whose sides are no numbers')
    dtype, objects = held.built, isinstance(content, list)
    if isinstance(content, str):  # of Python 2
        content = content.encode('latin1')
    there = len(content) * (dtype.itemsize if objects else 1)
    wanted = math.prod(shape) * dtype.itemsize
    budget.spend(unpacked=there)
    if objects != dtype.hasobject or there != wanted:
        raise ValueError(f'the pickle has an array of {wanted} bytes, but there are {there}')
    if not objects:
        return np.frombuffer(bytes(content), dtype).reshape(shape, order=order)
    flat = np.empty(len(content), dtype=object)
    for i, item in enumerate(content):
        flat[i] = item
    return flat.reshape(shape, order=order)


def _built(value: Any) -> Any:
    """An array in place of what stood for it."""
    held = isinstance(value, _Held) and isinstance(value.built, np.ndarray)
    return value.built if held else value
