"""Order of the messages of a stream by their stamps, unaffected by single stray stamps.

A message that is older than the previous one, or far ahead of it, is put aside. Once several
messages in a row agree on the later or earlier time, all of them are used: the source has paused,
or its clock was set. Messages that no other message confirms are stray.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from msg_tools.messages.headers import SECOND_NS

# Number of consecutive messages that confirm a jump in time, and minimum backward jump, ns, as a
# stream soon catches up after a shorter jump. EXPECTED_JUMP applies if backward jumps are expected.
CONFIRMING_MESSAGES, EXPECTED_JUMP = (3, SECOND_NS), (2, 0)
# Maximum forward step without confirmation by other messages, in ns and in message intervals of the
# stream; the larger limit applies.
_MIN_STEP_AHEAD_NS, _MIN_INTERVALS_AHEAD = SECOND_NS, 5


class Stamped(NamedTuple):
    """A message, and its stamp, ns."""

    stamp: int
    message: Any


class Turn(NamedTuple):
    """Outcome of the arrival of a message.

    Attributes:
        use: messages to use now, in their order.
        stray: messages that were put aside and are not used.
        late: whether the new message is skipped, as it is not newer than earlier messages.
        back: backward jump of the clock before the first message of `use`, ns; 0: no jump.
    """

    use: tuple[Stamped, ...] = ()
    stray: tuple[Stamped, ...] = ()
    late: bool = False
    back: int = 0


class StampOrder:
    """Orders the messages of one stream by their stamps.

    Attributes:
        newest: stamp of the newest message that could be used, ns, set by the caller; None before
            the first message.
    """

    def __init__(self) -> None:
        self.newest: int | None = None
        self._interval: int | None = None
        self._aside: tuple[Stamped, ...] = ()

    def put(self, one: Stamped, *, expected: bool) -> Turn:
        """Adds the next message; returns the messages that can now be used.

        Args:
            expected: whether backward jumps are expected, for example when a bag is played again.
        """
        newest, aside = self.newest, self._aside
        agreeing, least_back = EXPECTED_JUMP if expected else CONFIRMING_MESSAGES
        if newest is None or newest < one.stamp <= newest + self._longest():
            self._aside = ()
            return self._used((one,), stray=aside)
        ahead = one.stamp > newest
        if one.stamp in (newest, *(x.stamp for x in aside)) or (
            not ahead and newest - one.stamp < least_back
        ):
            return Turn(late=True)
        agrees = aside and aside[-1].stamp < one.stamp and ahead == (aside[-1].stamp > newest)
        self._aside, stray = ((*aside, one), ()) if agrees else ((one,), aside)
        if len(self._aside) < agreeing:
            return Turn(stray=stray)
        use, self._aside = self._aside, ()
        return self._used(use, back=max(newest - use[0].stamp, 0))

    def end(self) -> Turn:
        """End the stream: messages ahead are used, older messages put aside are stray."""
        aside, self._aside = self._aside, ()
        if aside and self.newest is not None and aside[0].stamp > self.newest:
            return self._used(aside)
        return Turn(stray=aside)

    def _longest(self) -> float:
        """Return the maximum interval to the next message that is not considered a jump, ns."""
        interval = self._interval
        return (
            float('inf')
            if interval is None
            else max(_MIN_STEP_AHEAD_NS, _MIN_INTERVALS_AHEAD * interval)
        )

    def _used(self, use: tuple[Stamped, ...], **turn: Any) -> Turn:
        before = use[-2].stamp if len(use) > 1 else self.newest
        if before is not None:
            self._interval = use[-1].stamp - before
        return Turn(use, **turn)
