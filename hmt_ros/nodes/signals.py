"""What a process does when it is asked to end."""

from __future__ import annotations

import atexit
import signal
from collections.abc import Callable


def on_signals(stop: Callable[..., None]) -> None:
    """Calls a function when a signal asks the process to end; while it ends, signals do nothing.

    A terminal and "ros2 launch" send one each. Python gives them back their usual effect before it
    has ended, and the second one would kill the process.
    """
    numbers = (signal.SIGINT, signal.SIGTERM)
    for number in numbers:
        signal.signal(number, stop)
    atexit.register(lambda: [signal.signal(number, signal.SIG_IGN) for number in numbers])
