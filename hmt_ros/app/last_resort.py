"""The border of a program: whatever it meets becomes a line on stderr and an exit code."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hmt_ros.app.progress import tell_user
from msg_tools.files.error_line import LONGEST_LINE, error_line, one_line

# Exit codes of programs that the interrupt key or SIGPIPE has ended, as shells report them; that of
# another signal is this and its number.
INTERRUPTED, NOBODY_READS, SIGNALLED = 130, 141, 128


def last_resort(
    program: str, run: Callable[[], int], *, debug: bool = False, lost: str = ''
) -> int:
    """Runs a program; any exception becomes one line of at most `LONGEST_LINE` on stderr.

    Args:
        debug: whether the traceback of an error is printed, too.
        lost: what becomes of the work when the interrupt key ends it.

    Returns:
        The exit code: that of `run`; 1 after an error; `INTERRUPTED`; or `NOBODY_READS` once the
        reader of stdout, say head, has ended.

    Raises:
        SystemExit: SIGTERM or SIGHUP asks the process to end.
    """
    _open_standard_files()
    try:
        with _ended_by_signals():
            try:
                return run()
            finally:
                # Otherwise the interpreter finds the closed pipe at its end, and prints an error.
                sys.stdout.flush()
    except BrokenPipeError:
        code = NOBODY_READS
    except KeyboardInterrupt:
        print(f'{program}: interrupted{lost}', file=sys.stderr)
        code = INTERRUPTED
    except Exception as error:  # noqa: BLE001 - no input is worth a traceback to whoever gives it
        if debug:
            traceback.print_exc()
        kind, hint = '', ''
        if not isinstance(error, (ValueError, OSError)):
            kind, hint = f'{type(error).__name__}: ', '; --debug shows where'
        text = one_line(f'{program}: {kind}{error_line(error, LONGEST_LINE)}', LONGEST_LINE)
        text = one_line(text, LONGEST_LINE - len(hint)) + hint
        print(text, file=sys.stderr)
        code = 1
    _drop_what_can_not_be_printed()
    return code


def _open_standard_files() -> None:
    """Opens the null device where one is closed: a file that is written must not take its place."""
    for number, name in ((1, 'stdout'), (2, 'stderr')):
        if getattr(sys, name) is None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)  # they may be the same
            setattr(sys, name, os.fdopen(number, 'w', encoding='utf-8'))


def _drop_what_can_not_be_printed() -> None:
    """Buffered text would be written at the end of the interpreter, which prints an error then."""
    try:
        sys.stdout.flush()
    except OSError:
        with Path(os.devnull).open('w', encoding='utf-8') as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())


class _Lines(logging.Handler):
    """Prints what a library logs as a line for the user."""

    def __init__(self, program: str) -> None:
        super().__init__(logging.WARNING)
        self._program, self._told = program, set[str]()

    def emit(self, record: logging.LogRecord) -> None:
        """Prints a record, once."""
        text = record.getMessage()
        if text not in self._told:
            self._told.add(text)
            tell_user(self._program, text)


@contextmanager
def told_in_lines(program: str) -> Iterator[None]:
    """Prints lines for the user alone.

    Warnings, and what ends in other threads or in a finaliser, become lines. What libraries in C
    print, libpng about a damaged image for example, is dropped.
    """

    def tell(ended: Any) -> None:
        tell_user(program, f'{ended.exc_type.__name__}: {error_line(ended.exc_value)}')

    root, lines, stderr = logging.getLogger(), _Lines(program), sys.stderr
    hooks = threading.excepthook, sys.unraisablehook
    shown = os.fdopen(os.dup(2), 'w', 1, stderr.encoding, stderr.errors)
    with shown, Path(os.devnull).open('w', encoding='utf-8') as nowhere:
        os.dup2(nowhere.fileno(), 2)
        sys.stderr = shown if stderr is sys.__stderr__ else stderr
        threading.excepthook = sys.unraisablehook = tell
        logging.captureWarnings(True)
        root.addHandler(lines)
        try:
            yield
        finally:
            root.removeHandler(lines)
            logging.captureWarnings(False)
            threading.excepthook, sys.unraisablehook = hooks
            sys.stderr = stderr
            os.dup2(shown.fileno(), 2)


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Signals that ask the process to end do so as an exception: what is unfinished is removed."""

    def end(number: int, _: object) -> None:
        raise SystemExit(SIGNALLED + number)

    numbers = [
        number
        for number in (signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is signal.SIG_DFL
        and threading.current_thread() is threading.main_thread()
    ]
    for number in numbers:
        signal.signal(number, end)
    try:
        yield
    finally:
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)
