"""What a case of the soak reports, what is a fault of our code, and how long a case may take."""

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

# What a case may need of memory beyond what the process had before, MB.
MOST_GROWTH = 150.0
# What may stay of it: buffers, and code that is loaded when it is first needed, MB.
MOST_KEPT = 25.0
# Faults that are told of a case; the others are counted.
_TOLD = 5


@dataclass
class Outcome:
    """What came of one case.

    Attributes:
        of: what it was done to: a node, or a kind of file.
        done: what was done.
        times: how often.
        refused: how often the answer was a clean error.
        lost: what had been acknowledged and is not there.
        growth_mb: of the peak of resident memory; None: not measured.
        kept_mb: growth that is left at the end.
        faults: what went wrong otherwise; empty: alive, or a clean error, every time.
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
        """Tells of something that must not be; the same thing once."""
        if text not in self.faults:
            self.faults.append(text)

    @property
    def met(self) -> bool:
        """Whether nothing was lost and nothing went wrong."""
        return self.told() == 'met'

    def told(self) -> str:
        """'met', or what was not."""
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
    """How much of a case is to be done.

    Attributes:
        times: how often, if time allows.
        seconds: that it may take.
    """

    times: int
    seconds: float

    def counted(self) -> Iterator[int]:
        """Numbers from 0, until it is enough."""
        end = time.monotonic() + self.seconds
        for number in range(self.times):
            yield number
            if time.monotonic() > end:
                return

    def part(self, share: float) -> Amount:
        """A share of it."""
        return Amount(max(1, round(share * self.times)), share * self.seconds)


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
