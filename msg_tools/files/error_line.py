"""Texts, parts of which may come from outside, as one short line for logs, messages and terminals.

Characters that a terminal obeys, or that change how others are shown, become escapes: control
characters, those that turn the direction of text, that have no width, or that stand for no text.
"""

from __future__ import annotations

# Characters of a line; one that a log puts its own words around is shorter.
LONGEST_LINE, LONGEST_TEXT = 300, 250


def one_line(text: str, most: int = LONGEST_TEXT) -> str:
    """A text without breaks and control characters, of at most `most` characters."""
    return printable(' '.join(_shortened(text, 100 * most).split()), most)


def error_line(error: BaseException, most: int = LONGEST_TEXT) -> str:
    """The text of an error as one line; its type where it has none."""
    return one_line(str(error), most) or type(error).__name__


def printable(text: str, most: int = LONGEST_LINE) -> str:
    """A line as it is but for its length, with escapes for what can not be printed."""
    shown = (x if x.isprintable() else ascii(x)[1:-1] for x in _shortened(text, most))
    return _shortened(''.join(shown), most)


def _shortened(text: str, most: int) -> str:
    """A text without its middle: the place stands at the start, the remedy at the end."""
    end = most // 3
    return text if len(text) <= most else f'{text[: most - end - 5]} ... {text[-end:]}'
