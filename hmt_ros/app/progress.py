"""Progress of a command on stderr: a tqdm bar on a terminal, else a line every few seconds.

A thread prints the bar or the lines, so that the command shows activity during long steps. Only
results are printed on stdout.

    with show_progress(str(output), 'images', total=120) as bar:
        for image in images:
            ...
            bar.update()
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from threading import Event, Thread
from typing import Any, TypeAlias, TypeVar

from tqdm import tqdm

from msg_tools.files.error_line import MAX_LINE, one_line, printable

Item = TypeVar('Item')
Progress: TypeAlias = 'tqdm[Any]'
Notify = Callable[[str], object]  # function that shows a line to the user

INTERVAL = 3.0  # time between two lines, s; a bar shows the time every second


class LineFile:
    """A file that prints all written text, for example the state of a bar, as lines on stderr."""

    def write(self, text: str) -> None:
        """Prints a new state of tqdm as a line; ignores the blanks that clear the last state."""
        if text.strip():
            print(printable(text.strip()), file=sys.stderr, flush=True)

    def flush(self) -> None:
        """Does nothing, because nothing is buffered."""


class _Bar(tqdm):
    """A bar that updates the time even while nothing is counted."""

    def __init__(self, interval: float, **options: Any) -> None:
        self._interval, self._ended = interval, Event()
        super().__init__(**options)
        if not self.disable:
            Thread(target=self._show_time, name='progress', daemon=True).start()

    def __iter__(self) -> Iterator[Any]:
        """Counts each item at once; tqdm counts only when it draws, but here a thread draws."""
        try:
            for item in self.iterable:
                yield item
                self.update()
        finally:
            self.close()

    def _show_time(self) -> None:
        while not self._ended.wait(self._interval):
            self.delay = 0  # so that tqdm also shows the final state
            self.refresh()

    def close(self) -> None:
        """Ends the thread and closes the bar."""
        self._ended.set()
        super().close()


def show_progress(
    what: str, unit: str = '', total: float | None = None, *, quiet: bool = False
) -> Progress:
    """The progress of a command, as a bar or as lines.

    Args:
        what: name of the new file, or a verb such as 'reading'.
        unit: name of the unit, in the plural; '' if nothing is counted.
        total: total number of units; None if unknown.
    """
    return with_progress(None, what, unit, total, quiet=quiet)


def with_progress(
    items: Iterable[Item] | None,
    what: str,
    unit: str,
    total: float | None = None,
    *,
    quiet: bool = False,
) -> tqdm[Item]:
    """Yields items and shows how many are finished; without items, the caller calls `update`."""
    options: dict[str, Any] = {'iterable': items, 'unit': f' {unit}', 'total': total}
    options['desc'] = one_line(what)
    if not unit:
        options['bar_format'] = '{desc}: {elapsed} so far'
    if quiet or _is_wide_terminal():
        # A bar below another bar is removed when it is complete.
        return _Bar(1.0, **options, disable=quiet, leave=None)
    # The thread prints all lines, the first one after the first interval.
    return _Bar(INTERVAL, **options, file=LineFile(), ncols=0, mininterval=math.inf, delay=math.inf)


def notify_user(command: str, text: str) -> None:
    """Prints a line for the user on stderr, above the bar of `show_progress`."""
    tqdm.write(one_line(f'{command}: {text}', MAX_LINE), file=sys.stderr)


def say(*texts: object, most: int = MAX_LINE) -> None:
    """Prints results on stdout, in printable lines of at most `most` characters."""
    for line in '\n'.join(map(str, texts)).split('\n'):
        print(printable(line, most), flush=True)


def _is_wide_terminal() -> bool:
    """Whether stderr is a terminal with room for a bar; a width of 0 occurs in containers."""
    try:
        return sys.stderr.isatty() and os.get_terminal_size(sys.stderr.fileno()).columns > 0
    except (OSError, ValueError):
        return False
