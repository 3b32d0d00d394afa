"""Converts untrusted text to one short line for logs, messages and terminals.

Characters that control a terminal or affect the display of other characters are escaped: control
characters, and characters that reverse the direction of text, have no width, or represent no text.
"""

from __future__ import annotations

# Maximum length of a line, and of a text that is a part of a line, characters.
MAX_LINE, MAX_TEXT = 300, 250


def one_line(text: str, most: int = MAX_TEXT) -> str:
    """Converts a text to one line without control characters, of at most `most` characters."""
    return printable(' '.join(_shortened(text, 100 * most).split()), most)


def error_line(error: BaseException, most: int = MAX_TEXT) -> str:
    """Message of an error as one line, or the name of its type if the message is empty."""
    return one_line(str(error), most) or type(error).__name__


def printable(text: str, most: int = MAX_LINE) -> str:
    """A line with escapes for unprintable characters, shortened if needed."""
    shown = (x if x.isprintable() else ascii(x)[1:-1] for x in _shortened(text, most))
    return _shortened(''.join(shown), most)


def _shortened(text: str, most: int) -> str:
    """Cuts out the middle of a long text; errors begin with the place and end with the remedy."""
    end = most // 3
    return text if len(text) <= most else f'{text[: most - end - 5]} ... {text[-end:]}'
