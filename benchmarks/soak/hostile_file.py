"""A hostile file, and text shared by many kinds of hostile files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

# Name that attacks a terminal: escape sequences, line ends, a change of text direction.
CONTROL = '/\x1b]0;owned\x07\x1b[2J\r\n\x9b31m\u202egpj\x7f\x08'
DIGITS = '9' * 1_000_000
DEEP = '[' * 100_000 + ']' * 100_000
# Short YAML whose aliases expand to ten thousand million entries.
ALIASES = 'a: &a [x, x, x, x, x, x, x, x, x, x]\n' + ''.join(
    f'{b}: &{b} [{", ".join([f"*{a}"] * 10)}]\n'
    for a, b in zip('abcdefghi', 'bcdefghij', strict=True)
)


@dataclass(frozen=True)
class Hostile:
    """A file made to attack its reader.

    Attributes:
        name: name of the file; its suffix selects the readers. A folder has none.
        content: bytes, text, or a function that returns them; None if `write` writes the file.
        write: function that writes the file to a path.
        routes: names of the readers; empty selects all for the suffix.
    """

    name: str
    content: bytes | str | Callable[[], bytes | str] | None = None
    write: Callable[[Path], object] | None = None
    routes: tuple[str, ...] = ()

    @property
    def suffix(self) -> str:
        """Suffix of the name, or 'folder'."""
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
    """Aliases in a list, the form of QoS profiles."""
    return '- ' + '\n- '.join(line.partition(': ')[2] for line in ALIASES.splitlines()) + '\n'


def bare(text: str) -> str:
    """A document indented for inclusion in another one."""
    return ''.join(f'    {line}\n' for line in text.splitlines())
