"""Invalid arguments of the compiled core: errors name them, and nothing crashes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest


def assert_arguments_are_checked(
    function: Callable[..., Any],
    named: dict[str, Any],
    outputs: str = '',
    free: str = '',
    unread: str = '',
) -> None:
    """Spoils each array in every way, also those in tuples, and asserts that it is refused.

    Args:
        function: function of the core.
        named: valid arguments by name, in order.
        outputs: names of the arguments that are written.
        free: names of arrays that may have any number of rows.
        unread: names of integer arrays whose values are not checked.
    """
    good = tuple(named.values())
    outputs_of, free_of, unread_of = outputs.split(), free.split(), unread.split()

    def call(*values: Any) -> None:
        known = zip(named, values)
        function(*(x if name in outputs_of else _read_only(x) for name, x in known))

    call(*good)
    with pytest.raises(TypeError, match='arguments'):
        call(*good[1:])
    for path, name, array in _arrays(good, list(named)):

        def spoilt(other: Any, path: tuple[int, ...] = path) -> tuple[Any, ...]:
            return tuple(_replaced(good, path, other))

        other_type = np.float32 if array.dtype == np.float64 else np.float64
        others = [np.zeros_like(array, dtype=other_type), array[..., None], array.tolist(), None]
        if array.size > 1:
            others.append(np.repeat(array, 2, axis=-1)[..., ::2])
        for other in others:
            with pytest.raises(TypeError, match=re.escape(name)):
                call(*spoilt(other))
        if name not in free_of:
            for other in (np.concatenate([array, array[:1]]), array[:0], array[:-1]):
                with pytest.raises(ValueError, match=r': wanted'):
                    call(*spoilt(other))
        if array.dtype == np.int64 and name not in unread_of:
            for number in (-2, 10**9):
                with pytest.raises(ValueError, match=re.escape(name)):
                    call(*spoilt(np.full_like(array, number)))
        if array.dtype == np.float64:
            for number in (np.nan, np.inf, -1e300):
                with suppress(ValueError):
                    call(*spoilt(np.full_like(array, number)))
        if name in outputs_of:
            with pytest.raises(TypeError, match=re.escape(name)):
                call(*spoilt(_read_only(array)))


def _arrays(
    values: tuple[Any, ...], names: list[str]
) -> Iterator[tuple[tuple[int, ...], str, np.ndarray]]:
    """Positions of the arrays in nested tuples, and their names in errors."""
    for i, (value, name) in enumerate(zip(values, names, strict=True)):
        if isinstance(value, np.ndarray):
            yield (i,), name, value
        elif hasattr(value, '_fields'):
            inner = [f'{name}.{field}' for field in value._fields]
            for path, own, array in _arrays(value, inner):
                yield (i, *path), own, array


def _replaced(values: tuple[Any, ...], path: tuple[int, ...], other: Any) -> tuple[Any, ...]:
    own = list(values)
    own[path[0]] = _replaced(values[path[0]], path[1:], other) if path[1:] else other
    return values._make(own) if hasattr(values, '_make') else tuple(own)


def _read_only(value: Any) -> Any:
    """The same memory as read-only arrays, also inside tuples."""
    if isinstance(value, tuple):
        own = [_read_only(x) for x in value]
        return value._make(own) if hasattr(value, '_make') else tuple(own)
    if not isinstance(value, np.ndarray):
        return value
    view = value.view()
    view.flags.writeable = False
    return view
