"""Progress of a command on stderr: a bar of tqdm on a terminal, a line every few seconds elsewhere.

Both come from a thread, so that a step which takes long shows that the command still works.
stdout is left to results.

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

from msg_tools.files.error_line import LONGEST_LINE, one_line, printable

Item = TypeVar('Item')
Progress: TypeAlias = 'tqdm[Any]'
Tell = Callable[[str], object]  # a line for the user

INTERVAL = 3.0  # s, between two lines; a bar shows the time every second


class LineFile:
    """A file that prints what is written to it, the state of a bar say, as a line on stderr."""

    def write(self, text: str) -> None:
        """Prints what tqdm would draw over its last state; nothing where it clears that."""
        if text.strip():
            print(printable(text.strip()), file=sys.stderr, flush=True)

    def flush(self) -> None:
        """Nothing is kept."""


class _Bar(tqdm):
    """A bar that shows the time also while nothing is counted."""

    def __init__(self, interval: float, **options: Any) -> None:
        self._interval, self._ended = interval, Event()
        super().__init__(**options)
        if not self.disable:
            Thread(target=self._show_time, name='progress', daemon=True).start()

    def __iter__(self) -> Iterator[Any]:
        """Counts each item at once; tqdm would count when it draws, which the thread does here."""
        try:
            for item in self.iterable:
                yield item
                self.update()
        finally:
            self.close()

    def _show_time(self) -> None:
        while not self._ended.wait(self._interval):
            self.delay = 0  # what has been shown is shown at the end, too
            self.refresh()

    def close(self) -> None:
        """Removes the bar, or leaves it."""
        self._ended.set()
        super().close()


def show_progress(
    what: str, unit: str = '', total: float | None = None, *, quiet: bool = False
) -> Progress:
    """The progress of a command, as a bar or as lines.

    Args:
        what: name of a file that is made, or a verb such as 'reading'.
        unit: name of the unit, in the plural; '' if nothing is counted.
        total: number of units of the whole; None if unknown.
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
    """The items; shows how many of them are done. None: `update` counts."""
    options: dict[str, Any] = {'iterable': items, 'unit': f' {unit}', 'total': total}
    options['desc'] = one_line(what)
    if not unit:
        options['bar_format'] = '{desc}: {elapsed} so far'
    if quiet or _is_wide_terminal():
        # One bar below another is removed at its end.
        return _Bar(1.0, **options, disable=quiet, leave=None)
    # The thread prints all lines, none before the first interval has passed.
    return _Bar(INTERVAL, **options, file=LineFile(), ncols=0, mininterval=math.inf, delay=math.inf)


def tell_user(command: str, text: str) -> None:
    """Prints a line for the user on stderr, above the bar of `show_progress`."""
    tqdm.write(one_line(f'{command}: {text}', LONGEST_LINE), file=sys.stderr)


def say(*texts: object, most: int = LONGEST_LINE) -> None:
    """Prints results on stdout, in lines of at most `most` characters that can be printed."""
    for line in '\n'.join(map(str, texts)).split('\n'):
        print(printable(line, most), flush=True)


def _is_wide_terminal() -> bool:
    """Whether stderr is a terminal with room for a bar; those of containers may have no columns."""
    try:
        return sys.stderr.isatty() and os.get_terminal_size(sys.stderr.fileno()).columns > 0
    except (OSError, ValueError):
        return False
