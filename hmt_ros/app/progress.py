"""Progress of a command on stderr: a bar on a terminal, a line every few seconds elsewhere.

Both come from a thread, so that a step which takes long shows that the command still works.
stdout is left to results.

    with show_progress(str(output), 'images', total=120) as bar:
        for image in images:
            ...
            bar.update()
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Generator, Iterable
from threading import Event, Thread
from typing import Any, TextIO, TypeAlias, TypeVar

from tqdm import tqdm

from hmt_ros.compiled_code import compiling

Item = TypeVar('Item')

INTERVAL = 3.0  # s, between two lines; a bar shows the time every second


class ProgressLines:
    """Progress as lines; nothing is printed before the first interval has passed.

    A context manager with the interface of tqdm, as far as it is used here.

    Args:
        what: name of the product, the beginning of each line.
        unit: name of the unit, in the plural; '' if nothing is counted.
        total: number of units of the whole; None if unknown; may be set later.
        file: where the lines go; None: stderr.
        clock: gives the time, s.
        ended: wakes the thread at the end; its `wait` takes the interval.
    """

    def __init__(
        self,
        what: str,
        unit: str,
        total: float | None = None,
        *,
        file: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
        ended: Event | None = None,
    ) -> None:
        self.total = total
        self._what, self._unit, self._clock = what, unit, clock
        self._file = sys.stderr if file is None else file
        self._ended = Event() if ended is None else ended
        self._count, self._printed, self._start = 0, False, clock()
        self._thread = Thread(target=self._print_lines, name='progress', daemon=True)

    def __enter__(self) -> ProgressLines:
        compiling()
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        if self._printed and kind is None:
            counted = f'{self._count} {self._unit} in ' if self._unit else ''
            self._print(f'{counted}{_duration(self._clock() - self._start)}')

    def update(self, n: int = 1) -> None:
        """Counts n more units as done."""
        self._count += n

    def line(self) -> str:
        """Units that are done, of the total, with their rate and the time left."""
        spent = self._clock() - self._start
        so_far = f'{_duration(spent)} so far'
        if compiling():
            so_far += ', compiling kernels, once'
        if not self._unit:
            return so_far
        count, total = self._count, self.total
        if total is not None and total < count:
            total = None  # a bag may have more than it tells
        done = f'{count} {self._unit}' if total is None else f'{count} of {total:.0f} {self._unit}'
        # The first one may have compiled the kernels: it tells nothing of those that follow.
        if count < 2 or not spent:
            return f'{done}, {so_far}'
        rate = count / spent
        rest = so_far if total is None else f'{_duration((total - count) / rate)} left'
        return f'{done}, {rate:.3g} a second, {rest}'

    def _print_lines(self) -> None:
        while not self._ended.wait(INTERVAL):
            self._printed = True
            self._print(self.line())

    def _print(self, text: str) -> None:
        print(f'{self._what}: {text}', file=self._file, flush=True)


class _Bar(tqdm):
    """A bar that shows the time also while nothing is counted."""

    def __init__(self, **options: Any) -> None:
        self._ended = Event()
        super().__init__(**options)
        if not self.disable:
            Thread(target=self._show_time, name='progress', daemon=True).start()

    def _show_time(self) -> None:
        while not self._ended.wait(1.0):
            self.refresh()

    def close(self) -> None:
        """Removes the bar, or leaves it."""
        self._ended.set()
        super().close()


Progress: TypeAlias = 'tqdm[Any] | ProgressLines'


def show_progress(
    what: str, unit: str = '', total: float | None = None, *, quiet: bool = False
) -> Progress:
    """The progress of a command, as a bar or as lines.

    Args:
        what: name of a file that is made, or a verb such as 'reading'.
        unit: name of the unit, in the plural; '' if nothing is counted.
        total: number of units of the whole; None if unknown.
    """
    if quiet or _is_wide_terminal():
        # One bar below another is removed at its end.
        return _Bar(desc=what, unit=f' {unit}', total=total, disable=quiet, leave=None)
    return ProgressLines(what, unit, total)


def with_progress(
    items: Iterable[Item], what: str, unit: str, total: float | None = None, *, quiet: bool = False
) -> Generator[Item, None, None]:
    """The items; shows how many of them are done."""
    with show_progress(what, unit, total, quiet=quiet) as bar:
        for item in items:
            yield item
            bar.update()


def tell_user(command: str, text: str) -> None:
    """Prints a line for the user on stderr, above the bar of `show_progress`."""
    tqdm.write(f'{command}: {text}', file=sys.stderr)


def _is_wide_terminal() -> bool:
    """Whether stderr is a terminal with room for a bar; those of containers may have no columns."""
    try:
        return sys.stderr.isatty() and os.get_terminal_size(sys.stderr.fileno()).columns > 0
    except (OSError, ValueError):
        return False


def _duration(seconds: float) -> str:
    return str(tqdm.format_interval(seconds))
