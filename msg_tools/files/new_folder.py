"""Writes folders and files as a whole or not at all.

Both are made under a hidden name beside their place, `.<name>.<random>.partial`, and renamed. They
are locked while they are made: those without a lock are left from a process that was killed, and
the next one that comes to the same place removes them. Links are neither replaced nor followed.
"""

from __future__ import annotations

import fcntl
import logging
import os
import re
import secrets
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import BinaryIO

_log = logging.getLogger(__name__)
_REPLACED, _PARTIAL = 'replaced', '.partial'


@dataclass(frozen=True)
class FolderKind:
    """Folders of files with known names; others are never replaced.

    Attributes:
        what: name of such a folder in messages: 'a bag'.
        marker: name of the file without which it is no such folder.
        own: patterns of the names of the other files that it may have.
    """

    what: str
    marker: str
    own: tuple[str, ...]

    def check_place(self, target: Path, *, overwrite: bool) -> None:
        """Raises ValueError where a folder can not come to its place.

        Args:
            overwrite: whether a folder of this kind that is there may be replaced.
        """
        if not os.path.lexists(target):
            return
        if not overwrite:
            raise ValueError(f'{target} exists; give another name, or --overwrite')
        names = sorted(path.name for path in target.iterdir()) if target.is_dir() else []
        foreign = self._foreign(names)
        if target.is_symlink() or self.marker not in names or foreign:
            why = f'it has {foreign[0]}' if foreign else f'it is not the folder of {self.what}'
            raise ValueError(f'{target} is not replaced: {why}; give another name')

    @contextmanager
    def new(self, target: Path, *, overwrite: bool) -> Iterator[Path]:
        """Where to make a folder, which comes to its place when all is written, or not at all.

        The yielded folder does not exist yet; after an error nothing is left behind.

        Raises:
            ValueError: see `check_place`.
            OSError: it can not be written.
        """
        target = target.absolute()
        self.check_place(target, overwrite=overwrite)
        missing = [folder for folder in target.parents if not folder.exists()]
        target.parent.mkdir(parents=True, exist_ok=True)
        with _without_remains(target, lambda left: self._fills(left, target.name)):
            around = Path(
                tempfile.mkdtemp(prefix=f'.{target.name}.', suffix=_PARTIAL, dir=target.parent)
            )
            try:
                with _locked(around):
                    yield around / target.name
                    self.check_place(target, overwrite=overwrite)
                    replaced = around / _REPLACED
                    if target.exists():
                        target.rename(replaced)
                    try:
                        (around / target.name).rename(target)
                    except BaseException:
                        if replaced.exists():
                            replaced.rename(target)
                        raise
            finally:
                shutil.rmtree(around, ignore_errors=True)
                for folder in missing:
                    with suppress(OSError):  # the new folder is in it
                        folder.rmdir()

    def _foreign(self, names: Iterable[str]) -> list[str]:
        """Those that are not of files of such a folder."""
        own = (self.marker, *self.own)
        return [x for x in names if not any(fnmatchcase(x, pattern) for pattern in own)]

    def _fills(self, left: Path, name: str) -> bool:
        """Whether all in a hidden folder is of a folder of this kind, by its name."""
        return left.is_dir() and all(
            not self._foreign(files)
            and all(x in (name, _REPLACED) or x.endswith(_PARTIAL) for x in folders)
            for _, folders, files in os.walk(left)
        )


def check_file_place(target: Path, *, overwrite: bool) -> None:
    """Raises ValueError where a file can not come to its place.

    Args:
        overwrite: whether a file that is there may be replaced; a link never is.
    """
    if not os.path.lexists(target):
        return
    if not overwrite:
        raise ValueError(f'{target} exists; give another name, or --overwrite')
    if target.is_symlink() or not target.is_file():
        raise ValueError(f'{target} is not replaced: it is a link or no file; give another name')


@contextmanager
def new_file(target: Path) -> Iterator[BinaryIO]:
    """A file to write, which comes to its place when all is written, or not at all.

    Raises:
        ValueError: see `check_file_place`; a file that is there is replaced.
        OSError: it can not be written.
    """
    target = target.absolute()
    check_file_place(target, overwrite=True)
    partial = target.with_name(f'.{target.name}.{secrets.token_hex(4)}{_PARTIAL}')
    with _without_remains(target, Path.is_file):
        try:
            with partial.open('xb') as file, _locked(partial):
                yield file
                file.flush()
                os.fsync(file.fileno())
                partial.replace(target)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Shows others that a file or a folder is being made."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    try:
        with suppress(OSError):  # a file system without locks, of a network for example
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _without_remains(target: Path, is_ours: Callable[[Path], bool]) -> Iterator[None]:
    """Names what killed processes have left beside a place, and removes it once work is done."""
    hidden = re.compile(rf'\.{re.escape(target.name)}\.[a-z0-9_]{{8}}{re.escape(_PARTIAL)}')
    beside = [x for x in sorted(target.parent.iterdir()) if hidden.fullmatch(x.name)]
    left = [x for x in beside if not x.is_symlink() and is_ours(x) and _is_abandoned(x)]
    for path in left:
        _log.warning('%s: left by a run that was killed; removed once this one succeeds', path)
    yield
    for path in filter(_is_abandoned, left):
        with suppress(OSError):
            path.unlink() if path.is_file() else shutil.rmtree(path)


def _is_abandoned(path: Path) -> bool:
    """Whether nobody makes a file or a folder any more; False where that can not be known."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return True
