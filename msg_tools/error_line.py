"""What an error says, for a log or a message of ours that is one line."""

from __future__ import annotations


def error_line(error: BaseException) -> str:
    """The text of an error as one line; its type where it has none."""
    return ' '.join(str(error).split()) or type(error).__name__
