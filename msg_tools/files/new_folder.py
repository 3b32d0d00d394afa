"""Writes folders as a whole or not at all."""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path


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
        own = (self.marker, *self.own)
        foreign = [x for x in names if not any(fnmatchcase(x, pattern) for pattern in own)]
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
        around = Path(
            tempfile.mkdtemp(prefix=f'.{target.name}.', suffix='.partial', dir=target.parent)
        )
        try:
            yield around / target.name
            self.check_place(target, overwrite=overwrite)
            replaced = around / 'replaced'
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


def unfinished_folders(target: Path) -> list[Path]:
    """Hidden folders in which a folder is made, or was when its process was killed."""
    target = target.absolute()
    if not target.parent.is_dir():
        return []
    pattern = re.compile(rf'\.{re.escape(target.name)}\.[a-z0-9_]{{8}}\.partial')
    return [folder for folder in sorted(target.parent.iterdir()) if pattern.fullmatch(folder.name)]
