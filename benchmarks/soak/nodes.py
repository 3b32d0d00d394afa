"""The soak of the nodes, in processes of their own, over DDS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

from benchmarks.machine import forget_peak, peak_memory, resident_memory
from benchmarks.soak.node_damage import damaged_bytes
from benchmarks.soak.node_lifecycle import killed, shut_down, transitions
from benchmarks.soak.node_parameters import changed_parameters
from benchmarks.soak.node_streams import (
    OVERLOAD,
    jumping_clock,
    overload,
    publisher_killed,
    two_publishers,
)
from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.scenes import scenes
from benchmarks.soak.watched_node import Silent, Watched
from hmt_ros.app.replay.player import LiveNodeError
from msg_tools.files.error_line import error_line

Case = Callable[[Watched, Amount, Outcome], None]

# What is said of it, the case, and how often it is done where transitions are made once.
CASES: tuple[tuple[str, Case, float], ...] = (
    ('transitions of the lifecycle in every order', transitions, 1.0),
    ('parameters changed while it runs', changed_parameters, 2.0),
    ('stamps and /clock that jump', jumping_clock, 1.0),
    ('a second publisher, an hour behind', two_publishers, 0.25),
    ('damaged bytes on topics and in services', damaged_bytes, 10.0),
    ('its publisher killed and replaced', publisher_killed, 0.02),
    (f'messages at {OVERLOAD:g} times its rate', overload, 2.5),
    ('shut down in every state, started again', shut_down, 0.015),
    ('killed while it computes, started again', killed, 0.02),
)


def nodes(amount: Amount) -> Iterator[Outcome]:
    """Every case with every node; a node goes from case to case while it lives."""
    seconds = amount.seconds / (len(scenes()) * len(CASES))
    for scene in scenes().values():
        with ExitStack() as running:
            watched: Watched | None = None
            for done, case, share in CASES:
                outcome = Outcome(scene.title, done)
                part = Amount(max(1, round(amount.times * share)), seconds)
                try:
                    if watched is None:
                        watched = running.enter_context(Watched(scene))
                        watched.warm_up()
                    _do(case, watched, part, outcome)
                except (LiveNodeError, Silent, TimeoutError) as error:
                    outcome.fault(error_line(error))
                    running.close()
                    watched = None
                yield outcome


def _do(case: Case, watched: Watched, part: Amount, outcome: Outcome) -> None:
    """Does a case with a node, and looks at its memory and at what it says."""
    process, said = watched.node.process.pid, len(watched.traces())
    forget_peak(process)
    before = resident_memory(process)
    case(watched, part, outcome)
    watched.check_alive()
    if watched.node.process.pid == process:
        outcome.growth_mb = max(peak_memory(process) - before, 0.0) / 1e6
    for text in watched.traces()[said:]:
        outcome.fault(text)
