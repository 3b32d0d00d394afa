"""Turns every exception of a program into a line on stderr and an exit code."""

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

from hmt_ros.app.progress import LineFile, notify_user
from msg_tools.files.error_line import MAX_LINE, error_line, one_line

# Exit codes after the interrupt key and after SIGPIPE, as in shells; for other signals, the offset
# of the exit code from the signal number.
INTERRUPTED, NOBODY_READS, SIGNALLED = 130, 141, 128
_HINT = '; --debug shows where'


def last_resort(
    program: str, run: Callable[[], int], *, debug: bool = False, lost: str = ''
) -> int:
    """Runs a program; any exception becomes one line on stderr, at most `MAX_LINE` long.

    Args:
        debug: whether to print the traceback of an error, too.
        lost: text after "interrupted" about the lost work.

    Returns:
        The exit code of `run`; 1 after an error; `INTERRUPTED`; or `NOBODY_READS` if the
        reader of stdout, for example head, has exited.

    Raises:
        SystemExit: the process received SIGTERM or SIGHUP.
    """
    # A new file must not get the descriptor of a closed stdout or stderr.
    sys.stdout, sys.stderr = sys.stdout or _null_device(1), sys.stderr or _null_device(2)
    for number in (signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_DFL:
            # An exception makes context managers remove unfinished files.
            signal.signal(number, lambda seen, _: sys.exit(SIGNALLED + seen))
    # Finalisers of objects in a traceback can print; they must run while stderr is redirected.
    with nullcontext() if debug else _errors_as_lines(program):
        try:
            try:
                return run()
            finally:
                # Otherwise the interpreter finds the closed pipe at exit, and prints an error.
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
            text = f'{program}: {kind}{error_line(error, MAX_LINE)}'
            print(f'{one_line(text, MAX_LINE - len(hint))}{hint}', file=sys.stderr)
            code = 1
    try:
        sys.stdout.flush()
    except OSError:
        # The interpreter would write the buffer at exit, and print an error.
        _null_device(sys.stdout.fileno())
    return code


def _null_device(number: int) -> TextIO:
    """Opens the null device under a given file descriptor."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), number)  # the two descriptors can be equal
    return os.fdopen(number, 'w', encoding='utf-8', closefd=False)


@contextmanager
def _errors_as_lines(program: str) -> Iterator[None]:
    """Prints warnings, logs, and errors in threads and finalisers as lines for the user.

    Output of C libraries on stderr, for example of libpng about a damaged image, is dropped.
    """

    def notify(error: BaseException, *_: object) -> None:
        notify_user(program, f'{type(error).__name__}: {error_line(error)}')

    def ended(found: Any) -> None:
        notify(found.exc_value)

    usual = sys.stderr
    shown = os.fdopen(os.dup(2), 'w', 1, usual.encoding, usual.errors)
    with (
        shown,
        _replaced(sys, stderr=shown if usual is sys.__stderr__ else usual, unraisablehook=ended),
        _replaced(threading, excepthook=ended),
        _replaced(warnings, showwarning=notify),
        _replaced(logging, lastResort=logging.StreamHandler(LineFile())),
    ):
        _null_device(2)
        try:
            yield
        finally:
            os.dup2(shown.fileno(), 2)


@contextmanager
def _replaced(module: ModuleType, **values: Any) -> Iterator[None]:
    """Replaces variables of a module within the context."""
    usual = {name: getattr(module, name) for name in values}
    vars(module).update(values)
    try:
        yield
    finally:
        vars(module).update(usual)
