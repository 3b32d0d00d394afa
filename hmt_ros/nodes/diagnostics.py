"""Rates of the messages that a node receives and uses, for its diagnostics."""

from __future__ import annotations

import math
import time
from collections import Counter


class Rates:
    """What happened in the last period of diagnostics.

    Args:
        name: of what is counted.
        done: what one calls those that were used.

    Attributes:
        dropped, faults, lost: of the period.
    """

    def __init__(self, name: str, done: str) -> None:
        self.dropped = 0
        self.faults = 0
        self.lost = 0
        self._name, self._done = name, done
        self._received = self._used = 0.0
        self._latencies: list[float] = []
        self._counts: Counter[str] = Counter()
        self._began = time.monotonic()

    def next_period(self, counts: Counter[str], latencies: list[float]) -> None:
        """Ends a period.

        Args:
            counts: 'received', 'dropped', 'faults', 'lost' and those used, of all time.
            latencies: of the period, s.
        """
        now = time.monotonic()
        # A node that was configured anew counts anew.
        change = counts - self._counts
        duration = max(now - self._began, 1e-3)
        self._received = change['received'] / duration
        self._used = change[self._done] / duration
        self.dropped, self.faults = change['dropped'], change['faults']
        self.lost = change['lost']
        self._latencies, self._counts, self._began = latencies, counts, now

    def values(self) -> list[tuple[str, str]]:
        """For diagnostics."""
        known = self._latencies or [math.nan]
        return [
            (f'{self._name} received a second', f'{self._received:.1f}'),
            (f'{self._name} {self._done} a second', f'{self._used:.1f}'),
            ('latency, mean, ms', f'{1e3 * sum(known) / len(known):.1f}'),
            ('latency, largest, ms', f'{1e3 * max(known):.1f}'),
        ]

    def line(self) -> str:
        """For the console."""
        latency = ''
        if self._latencies:
            mean = 1e3 * sum(self._latencies) / len(self._latencies)
            latency = f', latency {mean:.0f} ms'
        dropped = f', {self.dropped} dropped' if self.dropped else ''
        return (
            f'{self._received:.1f} {self._name} a second, {self._used:.1f} {self._done}'
            f'{latency}{dropped}'
        )
