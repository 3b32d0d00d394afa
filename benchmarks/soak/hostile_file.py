"""A hostile file, and text that many kinds of hostile files have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

# Names that reach a terminal: escape sequences, ends of lines, a change of direction.
CONTROL = '/\x1b]0;owned\x07\x1b[2J\r\n\x9b31m\u202egpj\x7f\x08'
DIGITS = '9' * 1_000_000
DEEP = '[' * 100_000 + ']' * 100_000
# As few characters as expand to ten thousand million.
ALIASES = 'a: &a [x, x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{b}: &{b} [{", ".join([f"*{a}"] * 10)}]\n'
    for a, b in zip('abcdefghi', 'bcdefghij', strict=True)
)


@dataclass(frozen=True)
class Hostile:
    """A file that somebody made on purpose.

    Attributes:
        name: of the file, whose suffix tells what reads it; a folder has none.
        content: bytes or text, or what makes them; None: `write` writes the file to a path.
        routes: what reads it; empty: all that read files with its suffix.
    """

    name: str
    content: bytes | str | Callable[[], bytes | str] | None = None
    write: Callable[[Path], object] | None = None
    routes: tuple[str, ...] = ()

    @property
    def suffix(self) -> str:
        """That of the name, or 'folder'."""
        return 'folder' if self.name.startswith('folder_') else Path(self.name).suffix

    def make(self, path: Path) -> None:
        """Writes the file."""
        if self.write is not None:
            self.write(path)
            return
        content = self.content() if callable(self.content) else self.content
        if isinstance(content, str):
            content = content.encode('utf-8', 'surrogatepass')
        path.write_bytes(content or b'')


def alias_bomb() -> str:
    """Aliases in a list, as profiles of quality of service are."""
    return '- ' + '\n- '.join(line.partition(': ')[2] for line in ALIASES.splitlines()) + '\n'


def bare(text: str) -> str:
    """A document inside of another one."""
    return ''.join(f'    {line}\n' for line in text.splitlines())
