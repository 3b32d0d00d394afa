"""Texts of errors as one line, for logs and messages."""

from __future__ import annotations


def one_line(text: str) -> str:
    """A text, parts of which may come from outside, without breaks."""
    return ' '.join(text.split())


def error_line(error: BaseException) -> str:
    """The text of an error as one line; its type where it has none."""
    return one_line(str(error)) or type(error).__name__
