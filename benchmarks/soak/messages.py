"""Soak test without DDS: damaged messages for the sessions of the nodes."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.machine import forget_peak, peak_memory, resident_memory
from benchmarks.mutations import damaged
from benchmarks.soak.outcome import Amount, Outcome, place, warnings_as_errors
from benchmarks.soak.scenes import Scene, scenes
from hmt_ros.sessions.image_inputs import PREDICTION
from hmt_ros.sessions.people_session import PeopleSession
from hmt_ros.sessions.session import Session
from hmt_ros.sessions.smoother_session import SmootherSession
from hmt_ros.sessions.track_start import prepare_start
from hmt_ros.sessions.tracking_session import TrackingSession
from msg_tools.files.error_line import error_line
from msg_tools.messages.cdr import deserialise, serialise

# Number of damaged messages before a valid one, which must be used.
_BETWEEN = 200
# Number of messages after which a session is replaced, because damage may have disabled it.
_LIFE = 500


def messages(amount: Amount, *, quick: bool = False) -> Iterator[Outcome]:
    """Sends messages to every subscriber and service of every node."""
    # Sessions do not depend on the process, so shared processes are skipped.
    alone = [scene for scene in scenes().values() if not scene.together]
    if quick:
        alone = [scenes()['bme_node']]
    count = len(alone)
    for scene in alone:
        with warnings_as_errors():
            outcome = _through(scene, amount.part(1.0 / count))
        yield outcome


def _through(scene: Scene, amount: Amount) -> Outcome:
    outcome = Outcome(scene.node, 'damaged messages, in process')
    fed = _Fed(scene, outcome)
    # All variants are loaded before the damage.
    for _ in scene.variants:
        fed.check()
        fed.begin()
    _damage(fed, amount)
    return outcome


@contextmanager
def _watched_memory(outcome: Outcome) -> Iterator[None]:
    """Records the maximum growth of this process's memory in the meantime."""
    forget_peak()
    before = resident_memory()
    yield
    grown = (peak_memory() - before) / 1e6
    outcome.growth_mb = max(grown, outcome.growth_mb or 0.0)
    gc.collect()
    outcome.kept_mb = (resident_memory() - before) / 1e6


class _Fed:
    """A session and its inputs.

    Args:
        scene: scene of the node.
        outcome: outcome to fill.
    """

    def __init__(self, scene: Scene, outcome: Outcome) -> None:
        self.scene, self.outcome = scene, outcome
        self._published: list[Any] = []
        self._lives = 0
        self.begin()

    @property
    def asked(self) -> str:
        """The source with the message type of the node's service."""
        return PREDICTION if PREDICTION in self.valid else self.scene.session.COUNTED

    def take(self, source: str, data: bytes) -> None:
        """Gives bytes to the session as its node would."""
        self.outcome.times += 1
        if self.outcome.times % _LIFE == 0:
            self.begin()
        try:
            message = deserialise(data, self.valid[source].__msgtype__)
        except Exception as error:  # noqa: BLE001
            # As in the node, because the errors of generated code are not specified.
            self.outcome.refused += 1
            self.session.refuse(source, error_line(error))
            return
        try:
            handled = self.session.take(source, message)
        except Exception as error:  # noqa: BLE001
            self.outcome.fault(f'{source}: {place(error)}')
            self.begin()
            return
        self.outcome.refused += bool(handled.faults)
        self._compare(handled.published)

    def ask(self, data: bytes) -> None:
        """Gives bytes to the node's service."""
        self.outcome.times += 1
        try:
            message = deserialise(data, self.valid[self.asked].__msgtype__)
        except Exception:  # noqa: BLE001
            self.outcome.refused += 1
            return
        try:
            ask(self.session, message)
        except (ValueError, ArithmeticError):
            self.outcome.refused += 1
        except Exception as error:  # noqa: BLE001
            self.outcome.fault(f'service: {place(error)}')

    def check(self) -> None:
        """Checks that a valid message is used after damage, at the latest by a fresh session."""
        for attempt in range(2):
            if attempt:
                # Damage may have left a wrong track or a timestamp in the future.
                self.begin()
            for source, message in self.scene.prelude:
                self.session.take(source, message)
            self._next += 1
            handled = self.session.take(self.scene.session.COUNTED, self.scene.message(self._next))
            self._published.clear()
            if not handled.faults:
                return
        self.outcome.fault(f'a valid message is refused: {handled.faults[0]}')

    def begin(self) -> None:
        """Starts a fresh session with the next variant."""
        changes = self.scene.variants[self._lives % len(self.scene.variants)]
        self._lives += 1
        self._next = 0
        self.valid = self.scene.valid(changes.get('image_transport', ''))
        parameters = replace(self.scene.parameters, **changes)
        self.session: Session[Any, Any] = self.scene.session(parameters, self._published.append)
        # The previous session and its track form a reference cycle.
        gc.collect()

    def _compare(self, told: tuple[tuple[str, int], ...]) -> None:
        """Checks that announced messages were published and can be read."""
        made = tuple((output.topic, output.stamp_ns) for output in self._published)
        if told != made:
            self.outcome.lost += len(set(told) - set(made)) or 1
        for output in self._published:
            deserialise(output.data, output.message.__msgtype__)
        self._published.clear()


def ask(session: Any, message: Any) -> None:
    """Does what the service of a node does with a message.

    Raises:
        ValueError, ArithmeticError: a clean refusal.
    """
    if isinstance(session, PeopleSession):
        # Its request is empty.
        prepare_start(session.parameters)
    elif isinstance(session, TrackingSession):
        prepare_start(session.parameters, message, session.state.body)
    elif isinstance(session, SmootherSession):
        stamp = message.header.stamp
        session.smooth_span(stamp.sec, stamp.nanosec)
    else:
        session.predict_once(message)


def _damage(fed: _Fed, amount: Amount) -> None:
    rng = np.random.default_rng(0)
    with _watched_memory(fed.outcome):
        for number in amount.counted():
            if number % _BETWEEN == 0:
                fed.check()
            sources = [*fed.valid, '']
            chosen = sources[int(rng.integers(0, len(sources)))]
            if chosen:
                fed.take(chosen, damaged(serialise(fed.valid[chosen]), rng))
            else:
                fed.ask(damaged(serialise(fed.valid[fed.asked]), rng))
        fed.check()
