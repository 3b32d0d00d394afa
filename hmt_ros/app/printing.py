"""What becomes of a program whose output nobody reads to the end."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

# As shells tell of a program that SIGPIPE has ended.
NOBODY_READS = 141


def until_nobody_reads(printing: Callable[[], int]) -> int:
    """The exit code of what prints, 141 where its reader has left, as `head` does."""
    try:
        try:
            return printing()
        finally:
            # Otherwise it is noticed when the interpreter ends, which tells of it.
            sys.stdout.flush()
    except BrokenPipeError:
        # What is still buffered is written at the end.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
        return NOBODY_READS
