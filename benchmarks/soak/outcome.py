"""Outcome and amount of a case of the soak test, and descriptions of faults."""

from __future__ import annotations

import os
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from msg_tools.files.error_line import error_line

# Maximum growth of a process's memory in a case, MB.
MOST_GROWTH = 150.0
# Maximum growth that remains, for buffers and code that is loaded late, MB.
MOST_KEPT = 25.0
# Maximum number of faults reported for a case; others are counted.
_TOLD = 5


@dataclass
class Outcome:
    """Outcome of one case.

    Attributes:
        of: subject of the test: a node, or a kind of file.
        done: description of the action.
        times: number of actions.
        refused: number of answers that were clean errors.
        lost: number of acknowledged things that are missing.
        growth_mb: growth of the peak resident memory, MB; None if not measured.
        kept_mb: growth that remains at the end, MB.
        faults: other faults; empty if every answer was good or a clean error.
    """

    of: str
    done: str
    times: int = 0
    refused: int = 0
    lost: int = 0
    growth_mb: float | None = None
    kept_mb: float = 0.0
    faults: list[str] = field(default_factory=list)

    def fault(self, text: str) -> None:
        """Adds a fault, unless it is known."""
        if text not in self.faults:
            self.faults.append(text)

    @property
    def met(self) -> bool:
        """Whether nothing was lost and nothing went wrong."""
        return self.told() == 'met'

    def told(self) -> str:
        """'met', or the unmet requirements."""
        texts = [f'{self.lost} lost'] if self.lost else []
        if (self.growth_mb or 0.0) > MOST_GROWTH:
            texts.append(f'wanted at most {MOST_GROWTH:g} MB')
        if self.kept_mb > MOST_KEPT:
            texts.append(f'{self.kept_mb:.0f} MB stay, wanted at most {MOST_KEPT:g} MB')
        texts += self.faults[:_TOLD]
        if len(self.faults) > _TOLD:
            texts.append(f'{len(self.faults) - _TOLD} other faults')
        return '; '.join(texts) or 'met'


@dataclass(frozen=True)
class Amount:
    """Limits of a case.

    Attributes:
        times: maximum number of actions.
        seconds: maximum duration, s.
    """

    times: int
    seconds: float

    def counted(self) -> Iterator[int]:
        """Numbers from 0 until a limit is reached."""
        end = time.monotonic() + self.seconds
        for number in range(self.times):
            yield number
            if time.monotonic() > end:
                return

    def part(self, share: float) -> Amount:
        """A share of both limits."""
        return Amount(max(1, round(share * self.times)), share * self.seconds)


@contextmanager
def warnings_as_errors() -> Iterator[None]:
    """Makes our warnings errors, and discards messages of libraries about damaged images."""
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
    """Type, place in our code, and text of an error."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [x for x in frames if any(name in x.filename for name in ('/hmt_ros/', '/msg_tools/'))]
    at = ours[-1] if ours else frames[-1]
    where = f'{at.name} of {at.filename.rpartition("/")[2]}'
    return f'{type(error).__name__} in {where}, {error_line(error)[:100]}'
