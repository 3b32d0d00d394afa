"""What is a fault of our code in the soak: what it raises unforeseen, and what it warns of."""

from __future__ import annotations

import os
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from msg_tools.files.error_line import error_line


@contextmanager
def warnings_as_errors() -> Iterator[None]:
    """What our code warns of is a fault; what libraries say of damaged pictures is nobody's."""
    with warnings.catch_warnings(), Path(os.devnull).open('w') as nothing:
        warnings.simplefilter('error', RuntimeWarning)
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(nothing.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)


def place(error: BaseException) -> str:
    """What was raised, and where in our code."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [x for x in frames if any(name in x.filename for name in ('/hmt_ros/', '/msg_tools/'))]
    at = ours[-1] if ours else frames[-1]
    where = f'{at.name} of {at.filename.rpartition("/")[2]}'
    return f'{type(error).__name__} in {where}, {error_line(error)[:100]}'
