"""Files that parameters name: allowed folders, and error messages that do not reveal content.

A client that sets parameters over ROS may not be allowed to read files on the node's machine.
Public error messages give the path of the file and the kind of fault, never the file's content.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from hmt_ros.body import model_names
from hmt_ros.experts import lifter, pose_predictor
from msg_tools.files.error_line import error_line, one_line

# Parameters that may name a file, each with a function that returns valid names other than files.
FILE_PARAMETERS: Mapping[str, Callable[[], Collection[str]]] = {
    'subject_file': tuple,
    'background_file': tuple,
    'body_model': model_names,
    'lifter': lambda: [lifter.SHIPPED],
    'model_file': lambda: [path.stem for path in pose_predictor.FOLDER.glob('*.npz')],
}


class NamedFileError(ValueError):
    """A parameter names a file that can not be used.

    Attributes:
        public: message that does not quote the file: parameter, path and kind of fault.
    """

    def __init__(self, text: str, public: str) -> None:
        super().__init__(text)
        self.public = public


@contextmanager
def named_file(parameter: str, path: str, wanted: str) -> Iterator[None]:
    """Replaces any exception that occurs while reading a parameter's file by `NamedFileError`.

    Args:
        wanted: kind of the file, in words.
    """
    try:
        yield
    except Exception as error:
        # Readers may raise any exception if a file is malformed.
        text = error_line(error)
        if not isinstance(error, ValueError):
            text = f'{parameter} {path}: {text}'
        raise NamedFileError(text, f'{parameter}: {path}: {_fault(error, wanted)}') from error


def public_line(error: BaseException) -> str:
    """Return the text of an error as one line, without the content of a file."""
    return one_line(error.public) if isinstance(error, NamedFileError) else error_line(error)


def check_place(parameter: str, path: str, folders: Collection[str]) -> None:
    """Checks that a parameter is allowed to name a file.

    Args:
        folders: folders that may contain the file, after links are resolved.

    Raises:
        ValueError: the file is in none of the folders (whether or not it exists), or is not a
            regular file.
    """
    names = ['', *FILE_PARAMETERS[parameter]()]
    if path in names:
        return
    real = Path(os.path.realpath(path))
    if not any(real.is_relative_to(os.path.realpath(folder)) for folder in folders):
        raise ValueError(
            f'{parameter}: {path} lies in no folder of file_folders, which are '
            f'{", ".join(folders)}: move it there, or name it at launch'
        )
    try:
        regular = stat.S_ISREG(real.stat().st_mode)
    except OSError:
        hint = f', nor a known name; these are {", ".join(names[1:])}' if names[1:] else ''
        raise ValueError(f'{parameter}: {path}: no such file{hint}') from None
    if not regular:
        raise ValueError(f'{parameter}: {path}: not a regular file')


def _fault(error: BaseException | None, wanted: str) -> str:
    """Return the kind of fault, with the line number of invalid YAML."""
    while error is not None:
        if (mark := getattr(error, 'problem_mark', None)) is not None:
            return f'not a {wanted}: line {mark.line + 1} is not YAML'
        if isinstance(error, OSError):
            return f'can not be read ({error.strerror or "no such file"})'
        error = error.__cause__
    return f'not a {wanted}; an offline replay with it says why'
