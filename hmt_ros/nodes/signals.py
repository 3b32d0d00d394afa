"""Handlers of the signals that end a process."""

from __future__ import annotations

import atexit
import signal
from collections.abc import Callable


def on_signals(stop: Callable[..., None]) -> None:
    """Calls `stop` on SIGINT and SIGTERM; ignores both signals while the process exits.

    Both the terminal and "ros2 launch" send a signal. Python restores the default handlers before
    it exits, so that the second signal would kill the process.
    """
    numbers = (signal.SIGINT, signal.SIGTERM)
    for number in numbers:
        signal.signal(number, stop)
    atexit.register(lambda: [signal.signal(number, signal.SIG_IGN) for number in numbers])
