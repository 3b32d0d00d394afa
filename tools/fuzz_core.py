"""Calls all functions of the core with corrupted arguments: they must return or raise an error.

    python tools/fuzz_core.py CALLS [SEED]

Good arguments are recorded from the tests of the core. With --verbose each call is printed before
it is made, so that the last line shows the one that crashed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import BuiltinFunctionType
from typing import Any

import numpy as np
import pytest

from hmt_ros import core

TESTS = Path(__file__).parents[1] / 'test'
KEPT = 8  # maximum number of recorded calls of each function
NUMBERS = (np.nan, np.inf, -np.inf, -1.0, 0.0, 1e-300, 1e300, -(2**63), 2**62, 2**31, -1, 3)
TYPES = (np.float32, np.float64, np.int64, np.int32, np.int8, np.uint8, np.bool_, '>f8', object)
EXTENTS = (0, 1, 2, 200)  # lengths of axes


class Recorder:
    """Wraps a function of the core, and records arguments of its calls."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function
        self.names = function.__doc__.rstrip(')\n').rpartition('(')[2].split()
        self.calls: list[tuple[Any, ...]] = []

    def __call__(self, *arguments: Any) -> Any:
        """Calls the function."""
        copies = copied(arguments) if len(self.calls) < KEPT else None
        result = self.function(*arguments)
        if copies is not None:
            self.calls.append(copies)
        return result


def copied(value: Any) -> Any:
    """Arguments with copies of their arrays."""
    return changed(value, lambda x: x.copy() if isinstance(x, np.ndarray) else x)


def changed(value: Any, change: Callable[[Any], Any]) -> Any:
    """Tuples with changed arrays and numbers."""
    if not isinstance(value, tuple):
        return change(value)
    own = [changed(x, change) for x in value]
    return value._make(own) if hasattr(value, '_make') else tuple(own)


def leaves(value: Any) -> Iterator[Any]:
    """The arrays and numbers in tuples."""
    if isinstance(value, tuple):
        for x in value:
            yield from leaves(x)
    else:
        yield value


def spoilt(value: Any, rng: np.random.Generator) -> Any:
    """A corrupted array or number."""
    number = NUMBERS[rng.integers(len(NUMBERS))]
    if not isinstance(value, np.ndarray):
        return (number, None, 'text', np.zeros(3))[rng.choice(4, p=[0.85, 0.05, 0.05, 0.05])]
    if value.dtype == object:
        return value
    with np.errstate(all='ignore'):
        way = rng.integers(9)
        if way < 3 and value.size:  # one number, or all
            result, given = value.copy(), np.asarray(number).astype(value.dtype)
            result.ravel()[rng.integers(value.size) if way else slice(None)] = given
            return result
        if way == 3:
            return value.astype(TYPES[rng.integers(len(TYPES))], copy=True)
        if way == 4:  # another length of an axis
            shape = [min(x, max(EXTENTS)) for x in value.shape] or [1]
            shape[rng.integers(len(shape))] = EXTENTS[rng.integers(len(EXTENTS))]
            return np.resize(value, shape) if value.size else np.zeros(shape, value.dtype)
        if way == 5:  # an empty array with a huge axis
            shape = [min(x, max(EXTENTS)) for x in value.shape] or [1]
            shape[rng.integers(len(shape))] = 0
            shape[rng.integers(len(shape))] = 0 if len(shape) == 1 else 2**31
            return np.zeros(shape, value.dtype) if 0 in shape else value[:0]
        if way == 6:
            return np.repeat(value[..., None], 2, axis=-1)[..., 0]
        if way == 7 and value.ndim:
            return value[::-1]
        if way == 8:
            return value[None]
        return np.rint(100.0 * rng.normal(size=value.shape)).astype(value.dtype)


def resized(arguments: tuple[Any, ...], rng: np.random.Generator) -> tuple[Any, ...]:
    """Arguments with all axes of one length resized, as for a body with other segments."""
    extents = [x for array in leaves(arguments) for x in np.shape(array)]
    if not extents:
        return arguments
    old, new = extents[rng.integers(len(extents))], EXTENTS[rng.integers(len(EXTENTS))]

    def resize(value: Any) -> Any:
        if not isinstance(value, np.ndarray) or old not in value.shape:
            return value
        shape = [new if x == old else min(x, 10**4) for x in value.shape]
        return np.resize(value, shape) if value.size else np.zeros(shape, value.dtype)

    return tuple(changed(x, resize) for x in arguments)


def spoil(arguments: tuple[Any, ...], rng: np.random.Generator) -> tuple[Any, ...]:
    """Arguments with a few corrupted values."""
    result: Any = copied(arguments)
    if rng.random() < 0.3:
        result = resized(result, rng)
    count = len(list(leaves(result)))
    for _ in range(rng.integers(3)):
        place = iter(range(count))
        wanted = int(rng.integers(count)) if count else -1
        result = changed(
            result,
            lambda x, place=place, wanted=wanted: spoilt(x, rng) if next(place) == wanted else x,
        )
    return tuple(result)


def recorded() -> dict[str, Recorder]:
    """The functions of the core, with arguments recorded from its tests."""
    found = {
        name: Recorder(value)
        for name, value in vars(core).items()
        if isinstance(value, BuiltinFunctionType)
    }
    vars(core).update(found)

    files = sorted(
        str(x)
        for x in (TESTS / 'core').glob('test_*.py')
        if x.stem not in ('test_build', 'test_fuzz')
    )
    files += [
        str(TESTS / name) for name in ('image/test_pose_energy.py', 'tracking/test_classes.py')
    ]
    if pytest.main(['-q', '-x', '--no-header', '-p', 'no:cacheprovider', *files]):
        raise SystemExit('the tests fail, from which good arguments come')
    return found


def run(calls: int, seed: int, *, verbose: bool) -> None:
    """Makes a number of calls; raises errors that do not name an argument."""
    functions = recorded()
    unused = sorted(name for name, x in functions.items() if not x.calls)
    if unused:
        raise SystemExit(f'no test calls {", ".join(unused)}')
    rng, names, crowded = np.random.default_rng(seed), list(functions), set[str]()
    for count in range(calls):
        own = functions[names[count % len(names)]]
        arguments = spoil(own.calls[rng.integers(len(own.calls))], rng)
        if verbose:
            show(f'{count} {own.function.__name__} {arguments}')
        try:
            own.function(*arguments)
        except (TypeError, ValueError) as error:
            if not str(error).startswith((*own.names, 'arguments:')):
                raise
        except MemoryError:  # huge, but valid
            crowded.add(own.function.__name__)
    if crowded:
        show(f'no memory for some calls of {", ".join(sorted(crowded))}')


def show(line: str) -> None:
    """Prints a line and flushes."""
    sys.stdout.write(f'{line}\n')
    sys.stdout.flush()


def main(argv: list[str]) -> int:
    """Runs the fuzz."""
    parser = argparse.ArgumentParser('fuzz', description=__doc__.splitlines()[0])
    parser.add_argument('calls', type=int)
    parser.add_argument('seed', type=int, nargs='?', default=0)
    parser.add_argument('--verbose', action='store_true')
    options = parser.parse_args(argv)
    np.set_printoptions(threshold=20)
    run(options.calls, options.seed, verbose=options.verbose)
    show(f'{options.calls} calls')
    return 0


if __name__ == '__main__':
    raise SystemExit(main(sys.argv[1:]))
