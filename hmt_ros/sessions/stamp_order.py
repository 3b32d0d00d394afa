"""The order of the messages of a stream, by their stamps; one stray stamp changes nothing.

A message that is not in order, as it is older than the one before or far ahead of it, is put aside.
Once several messages in a row agree that it is a later or an earlier time they are all used: the
source has paused, or its clock was set. Those that no other one confirms are stray.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from msg_tools.messages.headers import SECOND_NS

# Messages in a row that make another time true, and least step back that may be one of the clock,
# ns: a shorter one is soon caught up with. The same where such steps are expected.
AGREEING, EXPECTED = (3, SECOND_NS), (2, 0)
# Least step ahead that others must confirm, ns, and in intervals of the stream.
_AHEAD_NS, _INTERVALS = SECOND_NS, 5


class Stamped(NamedTuple):
    """A message, and its stamp, ns."""

    stamp: int
    message: Any


class Turn(NamedTuple):
    """Messages whose turn has come.

    Attributes:
        use: messages to use now, in their order.
        stray: messages that were put aside and are not used.
        late: whether the message itself is left out, as it is not younger than the one before.
        back: time by which the clock went back before the first of `use`, ns.
    """

    use: tuple[Stamped, ...] = ()
    stray: tuple[Stamped, ...] = ()
    late: bool = False
    back: int = 0


class StampOrder:
    """The order of one stream.

    Attributes:
        newest: stamp of the newest message that could be used, ns, which whoever uses them sets;
            None before the first.
    """

    def __init__(self) -> None:
        self.newest: int | None = None
        self._interval: int | None = None
        self._aside: tuple[Stamped, ...] = ()

    def put(self, one: Stamped, *, expected: bool) -> Turn:
        """Takes the next message.

        Args:
            expected: whether the clock of the messages may go back, as where a bag is played again.
        """
        newest, aside = self.newest, self._aside
        agreeing, least_back = EXPECTED if expected else AGREEING
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
        """The messages that no other one follows any more: those ahead are used."""
        aside, self._aside = self._aside, ()
        if aside and self.newest is not None and aside[0].stamp > self.newest:
            return self._used(aside)
        return Turn(stray=aside)

    def _longest(self) -> float:
        """Longest interval to the next message that is no jump, ns."""
        interval = self._interval
        return float('inf') if interval is None else max(_AHEAD_NS, _INTERVALS * interval)

    def _used(self, use: tuple[Stamped, ...], **turn: Any) -> Turn:
        before = use[-2].stamp if len(use) > 1 else self.newest
        if before is not None:
            self._interval = use[-1].stamp - before
        return Turn(use, **turn)
