"""Writes folders and files completely or not at all.

New folders and files are written into a hidden folder next to the target,
`.<name>.<random>.partial`, and then renamed. The hidden folder is locked while in use. A hidden
folder without a lock remains from a killed process, and is removed after the next write to the same
target. Links are neither replaced nor followed.
"""

from __future__ import annotations

import fcntl
import glob
import logging
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import BinaryIO

_log = logging.getLogger(__name__)
_REPLACED_SUFFIX, _PARTIAL_SUFFIX = 'replaced', '.partial'


@dataclass(frozen=True)
class FolderKind:
    """A kind of folder with known file names; other folders are never replaced.

    Attributes:
        what: name of such a folder in messages, for example 'a bag'.
        marker: name of the file that every such folder has.
        own: name patterns of all other files in such a folder.
    """

    what: str
    marker: str
    own: tuple[str, ...]

    def check_place(self, target: Path, *, overwrite: bool) -> None:
        """Raises ValueError if a folder of this kind can not be written at `target`.

        Args:
            overwrite: whether to accept an existing folder of this kind, which is then replaced.
        """
        if not os.path.lexists(target):
            return
        if not overwrite:
            raise ValueError(f'{target} exists; give another name, or --overwrite')
        names = sorted(path.name for path in target.iterdir()) if target.is_dir() else []
        foreign = _foreign(names, (self.marker, *self.own))
        if target.is_symlink() or self.marker not in names or foreign:
            why = f'it has {foreign[0]}' if foreign else f'it is not the folder of {self.what}'
            raise ValueError(f'{target} is not replaced: {why}; give another name')

    @contextmanager
    def new(self, target: Path, *, overwrite: bool) -> Iterator[Path]:
        """Yields a temporary path for the new folder, which is moved to `target` at the end.

        The yielded path does not exist yet. After an error all files are removed.

        Raises:
            ValueError: see `check_place`.
            OSError: the folder can not be written.
        """
        target = target.absolute()
        self.check_place(target, overwrite=overwrite)
        missing = [folder for folder in target.parents if not folder.exists()]
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with _replacement(target, (self.marker, *self.own)) as new:
                yield new
                self.check_place(target, overwrite=overwrite)
        finally:
            for folder in missing:
                with suppress(OSError):  # it contains the new folder
                    folder.rmdir()


def check_file_place(target: Path, *, overwrite: bool) -> None:
    """Raises ValueError if a file can not be written at `target`.

    Args:
        overwrite: whether to accept an existing file, which is then replaced; links are never
            accepted.
    """
    if os.path.lexists(target) and not overwrite:
        raise ValueError(f'{target} exists; give another name, or --overwrite')
    if target.is_symlink() or (target.exists() and not target.is_file()):
        raise ValueError(f'{target} is not replaced: it is a link or no file; give another name')
    if not os.access(target.absolute().parent, os.W_OK):
        raise ValueError(f'{target} can not be written: its folder is missing or not writable')


@contextmanager
def new_file(target: Path) -> Iterator[BinaryIO]:
    """Yields an open file, which is moved to `target` at the end, or removed on an error.

    Raises:
        ValueError: see `check_file_place`; an existing file is replaced.
        OSError: the file can not be written.
    """
    target = target.absolute()
    check_file_place(target, overwrite=True)
    with _replacement(target, (glob.escape(target.name),)) as new, new.open('xb') as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _replacement(target: Path, own: Sequence[str]) -> Iterator[Path]:
    """Yields a temporary path for a file or folder, which replaces the target at the end.

    Args:
        own: name patterns of the files that are written.
    """
    around = Path(
        tempfile.mkdtemp(prefix=f'.{target.name}.', suffix=_PARTIAL_SUFFIX, dir=target.parent)
    )
    replaced = around / _REPLACED_SUFFIX
    try:
        with locked(around):
            yield around / target.name
            if target.is_dir():
                target.rename(replaced)
            try:
                (around / target.name).rename(target)
            except BaseException:
                if replaced.exists():
                    replaced.rename(target)
                raise
            _remove_remains(target, own)
    finally:
        shutil.rmtree(around, ignore_errors=True)


@contextmanager
def locked(folder: Path) -> Iterator[bool | None]:
    """Locks a folder, so that other processes see that it is in use.

    Yields:
        Whether the folder was unlocked before; None if the file system has no locks, as on some
        network drives.
    """
    descriptor = os.open(folder, os.O_DIRECTORY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        free: bool | None = True
    except OSError as error:
        free = False if isinstance(error, BlockingIOError) else None
    try:
        yield free
    finally:
        os.close(descriptor)


def _remove_remains(target: Path, own: Sequence[str]) -> None:
    """Removes and logs hidden folders that killed processes have left beside the target."""
    hidden = re.compile(rf'\.{re.escape(target.name)}\.[a-z0-9_]{{8}}{re.escape(_PARTIAL_SUFFIX)}')
    with suppress(OSError):
        for path in sorted(target.parent.iterdir()):
            if hidden.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                with locked(path) as free:
                    if free and _holds_only(path, target.name, own):
                        shutil.rmtree(path)
                        _log.warning('%s: removed; a run that was killed had left it', path)


def _holds_only(folder: Path, name: str, own: Sequence[str]) -> bool:
    """Whether a hidden folder contains only files of an unfinished write."""
    return all(
        not _foreign(files, own)
        and not _foreign(folders, (glob.escape(name), _REPLACED_SUFFIX, f'*{_PARTIAL_SUFFIX}'))
        for _, folders, files in os.walk(folder)
    )


def _foreign(names: Iterable[str], own: Sequence[str]) -> list[str]:
    """Names that match none of the patterns."""
    return [x for x in names if not any(fnmatchcase(x, pattern) for pattern in own)]
