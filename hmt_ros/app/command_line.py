"""What all commands share: reading of arguments, error lines and exit codes."""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from msg_tools.files.error_line import error_line

# Exit codes of programs that the interrupt key or SIGPIPE has ended, as shells report them.
INTERRUPTED, NOBODY_READS = 130, 141


class CommandParser(argparse.ArgumentParser):
    """A parser of arguments for which a bad argument is bad input: one line and exit code 1."""

    def __init__(self, prog: str, description: str = '', epilog: str = '') -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )

    def error(self, message: str) -> NoReturn:
        """Raises ValueError."""
        raise ValueError(f'{message}; see --help')

    def add_output(self, metavar: str, what: str, text: str) -> None:
        """Adds --output, --overwrite and --quiet of a command that writes a folder.

        Args:
            metavar: name of the folder in the help.
            what: what it is, 'bag' for example.
            text: help text of --output.
        """
        self.add_argument('-o', '--output', type=Path, required=True, metavar=metavar, help=text)
        self.add_argument('--overwrite', action='store_true', help=f'replace an existing {what}')
        self.add_argument('--quiet', action='store_true', help='print only warnings and errors')

    def add_mixtures(self, verb: str) -> None:
        """Adds the bag, --truth, --topic and --body of a command that reads mixtures.

        Args:
            verb: what it does with them, 'evaluate' for example.
        """
        self.add_argument(
            'bag', type=Path, metavar='OUT', help='bag with mixtures: a folder or a file'
        )
        self.add_argument(
            '--truth',
            type=Path,
            metavar='FILE',
            help='true joint positions: a .npz file with stamps, joint_names and joints, or a bag '
            'with ground truth (default: the ground truth in OUT)',
        )
        self.add_argument(
            '--topic',
            action='append',
            default=[],
            dest='topics',
            metavar='NAME',
            help=f'{verb} only this topic; may be repeated (default: all topics with mixtures)',
        )
        self.add_argument(
            '--body',
            metavar='MODEL',
            help='body model of the poses: a name or a YAML file (default: the model that OUT '
            'names)',
        )


def run_command(
    parser: CommandParser,
    work: Callable[[argparse.Namespace], int],
    argv: Sequence[str] | None = None,
    *,
    whole_or_nothing: bool = False,
) -> int:
    """Runs a command.

    Args:
        parser: parser of its arguments; `prog` is the name of the command.
        work: the command; it raises ValueError or OSError on bad input.
        argv: arguments; None: those of the process.
        whole_or_nothing: whether an interrupted command writes nothing, which a line then reports.

    Returns:
        The exit code: that of `work`; 1 after bad input, which one line on stderr explains;
        `INTERRUPTED`; `NOBODY_READS`.
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


def until_nobody_reads(printing: Callable[[], int]) -> int:
    """The exit code of a function that prints; `NOBODY_READS` once its reader, say head, ends."""
    try:
        try:
            return printing()
        finally:
            # Otherwise the interpreter finds the closed pipe at its end, and prints an error.
            sys.stdout.flush()
    except BrokenPipeError:
        # What is still buffered is written at the end.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        return NOBODY_READS


def number(
    low: float, high: float, *, what: str = 'a number', unit: str = ''
) -> Callable[[str], float]:
    """Reader of a number in a range; errors name what is wanted and its unit."""

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
