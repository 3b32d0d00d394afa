"""Handlers of the signals that end a process."""

from __future__ import annotations

import atexit
import signal
from collections.abc import Callable


def on_signals(stop: Callable[..., None]) -> None:
    """Calls a function when a signal asks the process to end; ignores signals during its exit.

    A terminal and "ros2 launch" send one signal each. Python restores the default handlers before
    it exits, so the second signal would kill the process.
    """
    numbers = (signal.SIGINT, signal.SIGTERM)
    for number in numbers:
        signal.signal(number, stop)
    atexit.register(lambda: [signal.signal(number, signal.SIG_IGN) for number in numbers])
