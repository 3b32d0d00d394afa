"""The border of a program: whatever it meets becomes a line on stderr and an exit code."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import ModuleType
from typing import Any, TextIO

from hmt_ros.app.progress import LineFile, tell_user
from msg_tools.files.error_line import LONGEST_LINE, error_line, one_line

# Exit codes of programs that the interrupt key or SIGPIPE has ended, as shells report them; that of
# another signal is this and its number.
INTERRUPTED, NOBODY_READS, SIGNALLED = 130, 141, 128
_HINT = '; --debug shows where'


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
    # A file that is written must not take the place of one that is closed.
    sys.stdout, sys.stderr = sys.stdout or _nowhere(1), sys.stderr or _nowhere(2)
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            # As an exception, the signal has what is unfinished removed.
            signal.signal(number, lambda seen, _: sys.exit(SIGNALLED + seen))
    # The finalisers of what an error held run, and may print, while stderr is still redirected.
    with nullcontext() if debug else _told_in_lines(program):
        try:
            try:
                return run()
            finally:
                # Else the interpreter finds the closed pipe at its end, and prints an error.
                sys.stdout.flush()
        except BrokenPipeError:
            code = NOBODY_READS
        except KeyboardInterrupt:
            print(f'{program}: interrupted{lost}', file=sys.stderr)
            code = INTERRUPTED
        except Exception as error:  # noqa: BLE001 - no input is worth a traceback
            if debug:
                traceback.print_exc()
            usual = isinstance(error, (ValueError, OSError))
            kind, hint = ('', '') if usual else (f'{type(error).__name__}: ', _HINT)
            text = f'{program}: {kind}{error_line(error, LONGEST_LINE)}'
            print(f'{one_line(text, LONGEST_LINE - len(hint))}{hint}', file=sys.stderr)
            code = 1
    try:
        sys.stdout.flush()
    except OSError:
        # The interpreter would write what is buffered at its end, and print an error.
        _nowhere(sys.stdout.fileno())
    return code


def _nowhere(number: int) -> TextIO:
    """The null device as the open file of a number."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), number)  # they may be the same
    return os.fdopen(number, 'w', encoding='utf-8', closefd=False)


@contextmanager
def _told_in_lines(program: str) -> Iterator[None]:
    """Has all that is printed beside the results come as lines for the user.

    So do warnings, and what ends in other threads or in a finaliser. What libraries in C print,
    libpng about a damaged image for example, is dropped.
    """

    def tell(error: BaseException, *_: object) -> None:
        tell_user(program, f'{type(error).__name__}: {error_line(error)}')

    def ended(found: Any) -> None:
        tell(found.exc_value)

    usual = sys.stderr
    shown = os.fdopen(os.dup(2), 'w', 1, usual.encoding, usual.errors)
    with (
        shown,
        _replaced(sys, stderr=shown if usual is sys.__stderr__ else usual, unraisablehook=ended),
        _replaced(threading, excepthook=ended),
        _replaced(warnings, showwarning=tell),
        _replaced(logging, lastResort=logging.StreamHandler(LineFile())),
    ):
        _nowhere(2)
        try:
            yield
        finally:
            os.dup2(shown.fileno(), 2)


@contextmanager
def _replaced(module: ModuleType, **values: Any) -> Iterator[None]:
    """Replaces variables of a module for a while."""
    usual = {name: getattr(module, name) for name in values}
    vars(module).update(values)
    try:
        yield
    finally:
        vars(module).update(usual)
