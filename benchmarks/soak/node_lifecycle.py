"""Cases of the soak: a node is led through its lifecycle, shut down, and killed."""

from __future__ import annotations

import itertools
import signal
import time

import numpy as np

from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.watched_node import Watched
from hmt_ros.app.replay.player import LiveNodeError

# States are 1 unconfigured, 2 inactive, 3 active.
_FINALIZED = 4
# State and transition to the state that follows.
_CONFIGURE, _CLEANUP, _ACTIVATE, _DEACTIVATE = 1, 2, 3, 4
_FOLLOWING = {
    (1, _CONFIGURE): 2,
    (2, _CLEANUP): 1,
    (2, _ACTIVATE): 3,
    (3, _DEACTIVATE): 2,
}
_SHUTDOWN = {1: 5, 2: 6, 3: 7}


def transitions(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Every transition in every state, and on at random; those that do not exist are refused."""
    rng = np.random.default_rng(0)
    state = watched.state()
    open_pairs = set(itertools.product((1, 2, 3), (1, 2, 3, 4)))
    for _ in amount.counted():
        here = sorted(transition for at, transition in open_pairs if at == state)
        transition = int(rng.choice(here if here and rng.random() < 0.7 else [1, 2, 3, 4]))
        open_pairs.discard((state, transition))
        following = _FOLLOWING.get((state, transition))
        done = watched.change(transition)
        outcome.times += 1
        outcome.refused += not done
        if done != (following is not None):
            outcome.fault(f'transition {transition} in state {state}: success is {done}')
        state = following or state
        if (found := watched.state()) != state:
            outcome.fault(f'transition {transition} leads to {found}, wanted {state}')
            state = found
        if state == 3 and transition == _ACTIVATE and rng.random() < 0.3:
            watched.anew()
    while state != 3:
        watched.change({1: _CONFIGURE, 2: _ACTIVATE}[state])
        state = watched.state()
    watched.anew()


def shut_down(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """From every state; then it ends as the interrupt key wants."""
    for number in amount.counted():
        for transition in ((), (_DEACTIVATE,), (_DEACTIVATE, _CLEANUP))[number % 3]:
            watched.change(transition)
        state = watched.state()
        if not watched.change(_SHUTDOWN[state]) or watched.state() != _FINALIZED:
            outcome.fault(f'can not be shut down in state {state}')
        for transition in (1, 2, 3, 4):
            outcome.refused += not watched.change(transition)
        outcome.times += 1
        watched.node.stop_well()
        watched.restart()
    watched.anew()


def killed(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Killed while it computes: what it had answered is there; the next one takes over."""
    rng = np.random.default_rng(0)
    for _ in amount.counted():
        begin = time.monotonic()
        for _ in range(3):
            watched.next()
        one = (time.monotonic() - begin) / 3
        watched.node.publish(watched.scene.session.COUNTED, watched.scene.message(watched.index))
        watched.spin(float(rng.uniform(0.0, 1.5)) * one)
        watched.node.process.send_signal(signal.SIGKILL)
        watched.node.process.wait()
        watched.spin(0.2)
        while watched.node.has_answered:
            outcome.lost += not _has_come(watched)
        outcome.times += 1
        watched.restart()
        watched.anew()


def _has_come(watched: Watched) -> bool:
    """Whether all has come that an answer tells of, of a node that lives no more."""
    try:
        watched.node.answer('message', 0.0)
    except LiveNodeError:
        return False
    return True
