"""Where the rendering of a training set stands, so that one that was broken off goes on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

EVERY = 50  # groups between two marks

Bytes = NDArray[np.uint8]


class RenderingMark:
    """Keeps rendered silhouettes in a file, and their number in another one.

    Args:
        path: file (.npy) of the silhouettes; the other one is `path` with the suffix .json.
        settings: text that tells one training set from another.
    """

    def __init__(self, path: Path, settings: str) -> None:
        self._path, self._state, self._settings = path, path.with_suffix('.json'), settings
        self._packed: np.memmap[tuple[int, ...], np.dtype[np.uint8]] | None = None

    def begin(self, shape: Sequence[int], rng: np.random.Generator) -> tuple[Bytes, int]:
        """The silhouettes (shape), and the number of groups that are done.

        Random choices then go on as they would have.

        Raises:
            ValueError: the files are of another training set, or damaged.
        """
        done, mode = 0, 'w+'
        if self._path.exists() and self._state.exists():
            done, mode = self._taken_up(rng), 'r+'
        else:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        try:
            packed = np.lib.format.open_memmap(self._path, mode, np.uint8, tuple(shape))
        except ValueError as error:
            raise ValueError(f'{self._path} is damaged ({error}): remove it') from error
        if packed.shape != tuple(shape):
            raise ValueError(f'{self._path} has the shape {packed.shape}: remove it')
        self._packed = packed
        return packed, done

    def keep(self, done: int, rng: np.random.Generator) -> None:
        """Marks that a number of groups are done."""
        if self._packed is None or done % EVERY:
            return
        self._packed.flush()
        content = {'settings': self._settings, 'done': done, 'random': rng.bit_generator.state}
        partial = self._state.with_suffix('.part')
        partial.write_text(json.dumps(content))
        partial.replace(self._state)

    def remove(self) -> None:
        """Removes the files."""
        self._packed = None
        for path in (self._path, self._state):
            path.unlink(missing_ok=True)

    def _taken_up(self, rng: np.random.Generator) -> int:
        try:
            content = json.loads(self._state.read_text())
            settings, done = content['settings'], int(content['done'])
            if settings == self._settings:
                rng.bit_generator.state = content['random']
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f'{self._state} is damaged ({error}): remove it') from error
        if settings != self._settings:
            raise ValueError(
                f'{self._path} marks a training with other settings, {settings}: remove it, or '
                f'wanted {self._settings}'
            )
        return done
