"""What all commands have in common: how arguments are read, and how a command ends."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from typing import NoReturn

from hmt_ros.app.printing import until_nobody_reads
from msg_tools.files.error_line import error_line

# As shells tell of a program that the interrupt key has ended.
INTERRUPTED = 130


class CommandParser(argparse.ArgumentParser):
    """Bad arguments are bad input: one line and exit code 1."""

    def error(self, message: str) -> NoReturn:
        """Raises ValueError."""
        raise ValueError(f'{message}; --help tells more')


def run_command(
    parser: CommandParser,
    work: Callable[[argparse.Namespace], int],
    argv: Sequence[str] | None = None,
    *,
    whole_or_nothing: bool = False,
) -> int:
    """Runs a command.

    Args:
        parser: of its arguments; its `prog` is the name of the command.
        work: what it does with them; bad input is a ValueError or an OSError.
        argv: arguments; None: of the process.
        whole_or_nothing: where the interrupt key ends it, nothing is written, and a line says so.

    Returns:
        The exit code: that of `work`; 1 after bad input, which one line on stderr tells;
        `INTERRUPTED`; 141 where nobody reads what is printed any more.
    """

    def run() -> int:
        try:
            return work(parser.parse_args(argv))
        except BrokenPipeError:
            raise
        except (ValueError, OSError) as error:
            print(f'{parser.prog}: {error_line(error)}', file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            if not whole_or_nothing:
                raise
            print(f'{parser.prog}: interrupted, nothing is written', file=sys.stderr)
            return INTERRUPTED

    return until_nobody_reads(run)


def number(
    low: float, high: float, *, what: str = 'a number', unit: str = ''
) -> Callable[[str], float]:
    """Reader of a number in a range; what is said to be wanted, and in which unit."""

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f'wanted {what} from {low:g} to {high:g}{unit}, saw {text!r}'
            )
        return value

    return read


def whole_number(low: int, high: int = 2**63 - 1) -> Callable[[str], int]:
    """Reader of a whole number in a range."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(
                f'wanted a whole number from {low} to {high}, saw {text!r}'
            )
        return value

    return read
