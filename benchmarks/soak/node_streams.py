"""Cases of the soak: streams with jumps in time, of two publishers or a dead one, or too fast."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress

import numpy as np

from benchmarks.clips import ROOT
from benchmarks.publisher import STEP_NS, as_file
from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.scenes import stamped
from benchmarks.soak.watched_node import PATIENCE, Silent, Watched
from hmt_ros.app.replay.player import LiveNodeError, environment
from hmt_ros.sessions.handled import Handled
from msg_tools.messages.cdr import serialise

# Images a second, over what the node can take.
OVERLOAD = 5.0
# Messages of a publisher before it is killed.
_FROM_ANOTHER = 3


def jumping_clock(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Stamps and the clock of the simulation jump; every message is answered."""
    from rosgraph_msgs.msg import Clock

    rng = np.random.default_rng(0)
    clock = watched.player.node.create_publisher(Clock, '/clock', 10)
    watched.set(use_sim_time=True)
    for number in amount.counted():
        if number == amount.times // 2:
            watched.set(reset_on_time_jump=False)
        jump = (0, 1, -1, 3600, -3600, 2**31 - 1, -(2**31))[int(rng.integers(0, 7))]
        seconds = int(np.clip(watched.scene.start_ns // 10**9 + jump, -(2**31), 2**31 - 1))
        if abs(jump) > 10**9:
            seconds = jump
        time_message = Clock()
        time_message.clock.sec = seconds
        clock.publish(time_message)
        stamp = seconds * 10**9 + int(rng.integers(0, 10)) * STEP_NS
        handled = watched.send(
            watched.scene.session.COUNTED, stamped(watched.scene.message(0), stamp)
        )
        outcome.times += 1
        outcome.refused += bool(handled.faults)
        if handled.stamp_ns != stamp:
            outcome.fault(f'answered {handled.stamp_ns}, wanted {stamp}')
    watched.values()
    watched.player.node.destroy_publisher(clock)
    watched.set(reset_on_time_jump=True, use_sim_time=False)
    watched.anew()


def two_publishers(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """A second publisher an hour behind: its messages are skipped, none of the first is."""
    scene, player = watched.scene, watched.player
    topic, msgtype = scene.inputs[scene.session.COUNTED]
    other = player.node.create_publisher(player.classes[msgtype], topic, player.reliable)
    watched.set(reset_on_time_jump=False)
    end = time.monotonic() + PATIENCE
    while not other.get_subscription_count() and time.monotonic() < end:
        watched.spin(0.05)
    for number in amount.counted():
        behind = scene.stamp(watched.index) - 3600 * 10**9
        stamp = behind if number % 2 else scene.stamp(watched.index - 1)
        other.publish(serialise(stamped(scene.message(watched.index), stamp)))
        if not watched.answer(PATIENCE).faults:
            outcome.fault('a message that is older than the last is used')
        outcome.refused += 1
        if watched.next().faults:
            outcome.lost += 1
        outcome.times += 2
    watched.set(reset_on_time_jump=True)
    player.node.destroy_publisher(other)


def publisher_killed(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """A publisher dies in the middle of a stream, and another takes its place."""
    scene, counted = watched.scene, watched.scene.session.COUNTED
    topic, msgtype = scene.inputs[counted]
    file = watched.player.folder / 'messages'
    file.write_bytes(as_file([serialise(scene.message(i)) for i in range(20)]))
    for _ in amount.counted():
        watched.settle(0.1)
        first = scene.stamp(watched.index)
        command = [sys.executable, '-m', 'benchmarks.publisher', str(file), topic, msgtype]
        with subprocess.Popen(
            [*command, str(first), '20'],
            env={**os.environ, **environment(watched.player.domain)},
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
        ) as publisher:
            heard: list[Handled] = []
            end = time.monotonic() + PATIENCE
            try:
                while len(heard) < _FROM_ANOTHER:
                    if time.monotonic() > end:
                        raise LiveNodeError(f'{scene.node} does not hear a new publisher')
                    with suppress(Silent):
                        heard.append(watched.answer(0.5))
            finally:
                publisher.kill()
        heard += watched.settle(0.5)
        outcome.times += 1
        newest = max(handled.stamp_ns for handled in heard)
        watched.index += 1 + round((newest - first) / STEP_NS)
        if watched.next().faults:
            outcome.fault('a message after that of the publisher is not used')


def overload(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Messages faster than they can be used: bounded, the newest is used, drops are counted."""
    watched.settle(0.1)
    begin = time.monotonic()
    for _ in range(5):
        watched.next()
    interval = (time.monotonic() - begin) / 5 / OVERLOAD
    counts = _counts(watched)
    heard: list[Handled] = []
    due = time.monotonic()
    for _ in amount.counted():
        watched.node.publish(watched.scene.session.COUNTED, watched.scene.message(watched.index))
        watched.index += 1
        outcome.times += 1
        due += interval
        watched.spin(max(due - time.monotonic(), 0.0))
        while watched.node.has_answered:
            heard.append(watched.node.answer('message', PATIENCE))
    end = time.monotonic() + PATIENCE
    change: dict[str, int] = {}
    while time.monotonic() < end:
        heard += watched.settle(1.0)
        change = {what: count - counts[what] for what, count in _counts(watched).items()}
        if change['received'] == len(heard):
            break
    if heard[-1].stamp_ns != watched.scene.stamp(watched.index - 1):
        outcome.fault('the newest message is not the last that is used')
    if change['received'] != change['used'] + change['skipped'] + change['dropped']:
        outcome.fault(f'counts do not add up: {change}')
    # Those that were dropped are answered, too.
    outcome.lost += abs(change['received'] - len(heard))
    unheard = outcome.times - change['received']
    outcome.done += f': {change["used"]} used, {change["dropped"]} dropped and answered'
    if unheard:
        outcome.done += f', {unheard} not heard'


def _counts(watched: Watched) -> dict[str, int]:
    values = watched.values()
    session = watched.scene.session
    names = {
        'received': 'received',
        'used': session.DONE,
        'skipped': 'skipped',
        'dropped': 'dropped',
    }
    return {what: int(values[f'{session.UNIT}s {name}']) for what, name in names.items()}
