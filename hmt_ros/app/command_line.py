"""Common parts of all commands: argument parsing, error messages and exit codes."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn, TypeVar

import hmt_ros
from hmt_ros.app.last_resort import last_resort

MAX_IMAGE_SIDE = 10_000  # maximum side of an image, px

Number = TypeVar('Number', int, float)


class CommandParser(argparse.ArgumentParser):
    """An argument parser that reports a bad argument in one line, with exit code 1."""

    def __init__(self, prog: str, description: str = '', epilog: str = '') -> None:
        super().__init__(
            prog=prog,
            description=description,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.add_argument(
            '--debug',
            action='store_true',
            default=argparse.SUPPRESS,
            help='print the traceback of an error, and the output of libraries',
        )

    def error(self, message: str) -> NoReturn:
        """Raises ValueError instead of ending the process."""
        raise ValueError(f'{message}; see --help')

    def add_output(self, metavar: str, what: str, text: str, *, required: bool = True) -> None:
        """Adds --output, --overwrite and --quiet of a command that writes a folder.

        Args:
            what: kind of the folder, 'bag' for example.
        """
        self.add_argument(
            '-o', '--output', type=Path, required=required, metavar=metavar, help=text
        )
        self.add_argument('--overwrite', action='store_true', help=f'replace an existing {what}')
        self.add_argument('--quiet', action='store_true', help='print only warnings and errors')

    def add_gravity(self) -> None:
        """Adds --level and --gravity, for `gravity_of`."""
        tilt = self.add_mutually_exclusive_group()
        tilt.add_argument(
            '--level', action='store_true', help='the camera is level: gravity is down in the image'
        )
        tilt.add_argument(
            '--gravity',
            type=float,
            nargs=3,
            metavar=('X', 'Y', 'Z'),
            help='direction of gravity, three numbers of any scale: x to the right of the image, '
            'y down, z forward (default: not known)',
        )

    def add_mixtures(self, verb: str) -> None:
        """Adds the bag, --truth, --topic and --body of a command that reads mixtures.

        Args:
            verb: verb of the command, 'evaluate' for example.
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


def gravity_of(arguments: argparse.Namespace) -> list[float] | None:
    """The direction of gravity from --level or --gravity; None if neither is given."""
    return [0.0, 1.0, 0.0] if arguments.level else arguments.gravity


PROGRAM_HELP = """\
usage: python -m {program} <command> [arguments]

{about}

commands:
{commands}

python -m {program} <command> --help lists the arguments of a command. An error is reported in one
line on stderr; --debug after the name of the command adds the traceback.
{more}
options:
  -h, --help  show this help
  --version   show the version
"""


def run_program(
    program: str,
    commands: Mapping[str, tuple[str, str]],
    about: str,
    more: str = '',
    argv: Sequence[str] | None = None,
) -> int:
    """Runs one of the commands of a package.

    Args:
        program: name of the package.
        commands: module and description by command name; a module is imported when its command
            runs.
        about, more: texts of the help, before and after the commands.
        argv: name and arguments of the command; None selects the arguments of the process.

    Returns:
        The exit code: 0 on success, 1 for bad input (explained in one line on stderr).
    """
    words = list(sys.argv[1:] if argv is None else argv)

    def run() -> int:
        command, *rest = words or ['']
        if command in ('-h', '--help'):
            width = max(map(len, commands))
            lines = '\n'.join(f'  {name:{width}}  {what}' for name, (_, what) in commands.items())
            text = PROGRAM_HELP.format(program=program, about=about, commands=lines, more=more)
            print(text, end='')
            return 0
        if command == '--version':
            print(f'{program} {hmt_ros.__version__}')
            return 0
        if command not in commands:
            seen = f'no command {command!r}' if command else 'no command given'
            raise ValueError(f'{seen}, wanted one of {", ".join(commands)}')
        return int(importlib.import_module(commands[command][0]).main(rest))

    return last_resort(program, run, debug='--debug' in words)


def run_command(
    parser: CommandParser,
    work: Callable[[argparse.Namespace], int],
    argv: Sequence[str] | None = None,
    *,
    whole_or_nothing: bool = False,
) -> int:
    """Runs a command with its arguments.

    Args:
        parser: argument parser of the command; `prog` is the name of the command.
        work: function of the command; it raises ValueError or OSError on bad input.
        argv: arguments of the command; None selects the arguments of the process.
        whole_or_nothing: whether an interrupted command writes nothing, so that the error message
            can say so.

    Returns:
        The exit code of `work`, or of `last_resort` after an exception.
    """
    words = list(sys.argv[1:] if argv is None else argv)

    def run() -> int:
        arguments = parser.parse_args(words)
        vars(arguments).pop('debug', None)
        return work(arguments)

    lost = ', nothing is written' if whole_or_nothing else ''
    return last_resort(parser.prog, run, debug='--debug' in words, lost=lost)


def number(
    low: float, high: float, *, what: str = 'a number', unit: str = ''
) -> Callable[[str], float]:
    """Returns a parser for numbers in a range; error messages name the range and the unit."""
    return _reader(float, low, high, f'{what} from {low:g} to {high:g}{unit}')


def whole_number(low: int, high: int = 2**63 - 1) -> Callable[[str], int]:
    """Returns a parser for whole numbers in a range."""
    return _reader(int, low, high, f'a whole number from {low} to {high}')


def _reader(kind: type[Number], low: float, high: float, wanted: str) -> Callable[[str], Number]:
    """Returns a parser for numbers of a type in a range."""

    def read(text: str) -> Number:
        with suppress(ValueError):
            value = kind(text)
            if low <= value <= high:
                return value
        raise argparse.ArgumentTypeError(f'wanted {wanted}, saw {text!r}')

    return read


def image_size(text: str) -> tuple[int, int]:
    """Reads width and height of images, px."""
    width, _, height = text.lower().partition('x')
    if not (width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f'wanted a size such as 640x480, saw {text!r}')
    if not (8 <= int(width) <= MAX_IMAGE_SIDE and 8 <= int(height) <= MAX_IMAGE_SIDE):
        raise argparse.ArgumentTypeError(f'wanted sides of 8 to {MAX_IMAGE_SIDE} px, saw {text!r}')
    return int(width), int(height)
