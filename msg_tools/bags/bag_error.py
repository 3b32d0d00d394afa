"""The one error that reading and writing bags raises."""

from __future__ import annotations

from msg_tools.files.error_line import error_line


class BagError(ValueError):
    """A bag that can not be read or written, in one line: what was seen, wanted, and what to do."""

    def __init__(self, text: str) -> None:
        super().__init__(' '.join(text.split()))


def reason(error: BaseException) -> str:
    """What an exception of a library says, short enough for a line of ours."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = error_line(error)
    return text if len(text) <= 160 else f'{text[:157]}...'
