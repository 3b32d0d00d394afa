"""The soak of the nodes, in processes of their own, over DDS."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.machine import forget_peak, peak_memory, resident_memory
from benchmarks.mutations import damaged
from benchmarks.soak_outcome import Amount, Outcome
from benchmarks.soak_publisher import as_file
from benchmarks.soak_scenes import CLIP, ROOT, STEP_NS, Scene, scenes, stamped
from hmt_ros.app.live_node import LiveNode, LiveNodeError, Player, environment
from hmt_ros.nodes.declared_parameters import DeclaredParameter, declared_parameters
from hmt_ros.nodes.filter_session import PREDICTION
from hmt_ros.nodes.handled import Handled
from hmt_ros.nodes.smoother_session import BODY
from msg_tools.cdr import canonical, serialise
from msg_tools.error_line import error_line

# Messages before memory is compared: kernels are compiled, buffers have grown.
_WARM = 8
# How long one message may take, s.
_PATIENCE = 60.0
# How long a valid message is waited for that may have been sent too early, s.
_SHORT = 2.0
# Images a second, over what the node can take.
_OVERLOAD = 5.0
# Messages of a publisher before it is killed.
_FROM_ANOTHER = 3
# Bytes of a bag in which messages stand already.
_BEGUN = 100_000
_STATES = {'unconfigured': 1, 'inactive': 2, 'active': 3, 'finalized': 4}
# State and transition to the state that follows.
_CONFIGURE, _CLEANUP, _ACTIVATE, _DEACTIVATE = 1, 2, 3, 4
_FOLLOWING = {
    (1, _CONFIGURE): 2,
    (2, _CLEANUP): 1,
    (2, _ACTIVATE): 3,
    (3, _DEACTIVATE): 2,
}
_SHUTDOWN = {1: 5, 2: 6, 3: 7}


class Watched:
    """A node that runs, what it publishes, and what it says.

    Args:
        scene: of the node.
        changes: of its parameters.
    """

    def __init__(self, scene: Scene, **changes: Any) -> None:
        self.scene, self._changes = scene, changes
        self._opened = ExitStack()
        self.restart()

    def restart(self) -> None:
        """Starts it, in a domain of its own; ends the one that ran before."""
        self._opened.close()
        self.index = 0
        scene = self.scene
        with ExitStack() as opened:
            self.player = Player(opened)
            self.node = LiveNode(
                self.player,
                opened,
                scene.node,
                replace(scene.parameters, reset_on_time_jump=True, **self._changes),
                inputs=scene.inputs,
                topics=scene.topics,
                sensors=scene.sensors,
                latched=(BODY,),
                write=_ignored,
            )
            self.node.wait_until_active()
            self.node.wait_for_subscribers(tuple(scene.topics), 1)
            self._opened = opened.pop_all()

    def __enter__(self) -> Watched:
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()

    def warm_up(self) -> None:
        """Until all is loaded; after that memory is compared."""
        for source, message in self.scene.prelude:
            self.send(source, message)
        for _ in range(_WARM):
            self.next()

    def send(self, source: str, message: Any) -> Handled:
        """A message in lock step; what became of it."""
        self.node.publish(source, message)
        return self.node.answer(source, _PATIENCE)

    def next(self) -> Handled:
        """The next valid message in lock step."""
        self.index += 1
        return self.send(self.scene.counted, self.scene.message(self.index - 1))

    def anew(self) -> None:
        """Valid messages from the first on, until one is used: a session has begun."""
        self.index = 0
        end = time.monotonic() + _PATIENCE
        while time.monotonic() < end:
            for source, message in self.scene.prelude:
                self.node.publish(source, message)
            self.node.publish(self.scene.counted, self.scene.message(self.index))
            self.index += 1
            with suppress(_Silent):
                while True:
                    handled = self.answer(_SHORT)
                    if handled.source == self.scene.counted and not handled.faults:
                        self.settle()
                        return
        raise LiveNodeError(f'the {self.node.title} uses no message any more')

    def answer(self, seconds: float) -> Handled:
        """What became of a message.

        Raises:
            _Silent: nothing is heard.
        """
        end = time.monotonic() + seconds
        while not self.node.has_answered:
            if time.monotonic() > end:
                raise _Silent
            self.check_alive()
            self.player.executor.spin_once(timeout_sec=0.02)
        return self.node.answer('message', _PATIENCE)

    def settle(self, seconds: float = 0.5) -> list[Handled]:
        """What it tells of messages, until it is silent for a while."""
        found = []
        with suppress(_Silent):
            while True:
                found.append(self.answer(seconds))
        return found

    def check_alive(self) -> None:
        """Raises LiveNodeError where the process has ended."""
        code = self.node.process.poll()
        if code is not None:
            words = self.node.output().strip().splitlines()[-1:]
            raise LiveNodeError(f'{self.scene.node} ended with code {code}: {" ".join(words)}')

    def change(self, transition: int) -> bool:
        """Whether a transition has been made."""
        from lifecycle_msgs.msg import Transition
        from lifecycle_msgs.srv import ChangeState

        asked = Transition(id=transition)
        return bool(self.node.call(ChangeState, 'change_state', transition=asked).success)

    def state(self) -> int:
        """Number of the state of its lifecycle."""
        from lifecycle_msgs.srv import GetState

        return int(self.node.call(GetState, 'get_state').current_state.id)

    def set(self, **values: Any) -> tuple[bool, str]:
        """Sets parameters all at once; whether that was done, and why not."""
        from rcl_interfaces.srv import SetParametersAtomically
        from rclpy.parameter import Parameter

        given = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        found = self.node.call(
            SetParametersAtomically, 'set_parameters_atomically', parameters=given
        ).result
        return bool(found.successful), str(found.reason)

    def get(self, names: list[str]) -> list[Any]:
        """Values of parameters."""
        from rcl_interfaces.srv import GetParameters
        from rclpy.parameter import parameter_value_to_python

        found = self.node.call(GetParameters, 'get_parameters', names=names).values
        return [parameter_value_to_python(value) for value in found]

    def values(self) -> dict[str, str]:
        """The values of its next diagnostics."""
        diagnostics = self.player.diagnostics
        diagnostics.pop(self.node.full_name, None)
        end = time.monotonic() + _PATIENCE
        while self.node.full_name not in diagnostics:
            if time.monotonic() > end:
                raise LiveNodeError(f'{self.scene.node} tells no diagnostics')
            self.check_alive()
            self.player.executor.spin_once(timeout_sec=0.1)
        return diagnostics[self.node.full_name]

    def traces(self) -> list[str]:
        """What it has said that no user should see."""
        lines = self.node.output().splitlines()
        return [
            f'said {line.strip()[:120]}'
            for line in lines
            if 'Error' in line.partition(':')[0].split('.')[-1] and not line.startswith('[')
        ] or [f'said {line[:120]}' for line in lines if 'Traceback' in line or 'Warning:' in line]

    def spin(self, seconds: float) -> None:
        """Listens for a while."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.player.executor.spin_once(timeout_sec=left)


class _Silent(Exception):
    """Nothing was heard in time."""


Case = Callable[[Watched, Amount, Outcome], None]


def nodes(amount: Amount) -> Iterator[Outcome]:
    """Every case with every node; a node goes from case to case while it lives."""
    pairs = [(scene, case) for scene in scenes().values() for case in _CASES]
    watched: Watched | None = None
    for scene, (done, case, share) in pairs:
        if watched is not None and watched.scene is not scene:
            watched.__exit__()
            watched = None
        outcome = Outcome(scene.node, done)
        part = Amount(max(1, round(amount.times * share)), amount.seconds / len(pairs))
        try:
            if watched is None:
                watched = Watched(scene)
                watched.warm_up()
            process, said = watched.node.process.pid, len(watched.traces())
            forget_peak(process)
            before = resident_memory(process)
            case(watched, part, outcome)
            watched.check_alive()
            if watched.node.process.pid == process:
                outcome.growth_mb = max(peak_memory(process) - before, 0.0) / 1e6
            for text in watched.traces()[said:]:
                outcome.fault(text)
        except (LiveNodeError, _Silent, TimeoutError) as error:
            outcome.fault(error_line(error))
            if watched is not None:
                watched.__exit__()
                watched = None
        yield outcome
    if watched is not None:
        watched.__exit__()


# The cases.


def _transitions(watched: Watched, amount: Amount, outcome: Outcome) -> None:
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


def _parameters(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Random values, valid or not, between messages; what was agreed to is there."""
    rng = np.random.default_rng(0)
    declared = [p for p in declared_parameters(watched.scene.parameters) if p.effect != 'at launch']
    usual = {p.name: p.default for p in declared}
    usual['reset_on_time_jump'] = True
    known = dict(usual)
    for number in amount.counted():
        chosen = declared[int(rng.integers(0, len(declared)))]
        value = _any_value(chosen, rng)
        done, why = watched.set(**{chosen.name: value})
        outcome.times += 1
        outcome.refused += not done
        if done:
            known[chosen.name] = value
        elif not why or '\n' in why:
            outcome.fault(f'{chosen.name} = {value!r} is refused with {why!r}')
        (found,) = watched.get([chosen.name])
        if found != known[chosen.name]:
            outcome.lost += 1
            outcome.fault(f'{chosen.name} is {found!r}, was set to {known[chosen.name]!r}')
        if number % 4 == 0:
            watched.next()
        if number % 25 == 24:
            _set_back(watched, usual, known, outcome)
    _set_back(watched, usual, known, outcome)
    watched.next()


def _set_back(
    watched: Watched, usual: Mapping[str, Any], known: dict[str, Any], outcome: Outcome
) -> None:
    changed = {name: usual[name] for name in usual if known[name] != usual[name]}
    if not changed:
        return
    done, why = watched.set(**changed)
    if not done:
        outcome.fault(f'the usual values are refused: {why}')
    known.update(usual)


def _any_value(parameter: DeclaredParameter, rng: np.random.Generator) -> Any:
    """A value of a parameter: near the usual one, at a limit, beyond, or of another type."""
    default, kind = parameter.default, rng.random()
    if kind < 0.1:
        wrong: tuple[Any, ...] = ('', 'pigeon', -1, 2**40, float('nan'), True, [1, 2], [b'x'])
        return wrong[int(rng.integers(0, len(wrong)))]
    if isinstance(default, bool):
        return bool(rng.random() < 0.5)
    if isinstance(default, str):
        return ('', default, 'nowhere', default * 2, '/dev/null', '\n')[int(rng.integers(0, 6))]
    low, high = parameter.limits or (-1e9, 1e9)
    if kind < 0.2:
        value = (low - 1, high + 1, -1e300, np.inf, -np.inf)[int(rng.integers(0, 5))]
        return value if isinstance(default, float) or not np.isfinite(value) else int(value)
    near = float(np.clip(default * np.exp2(rng.uniform(-1.0, 1.0)), low, high))
    return near if isinstance(default, float) else round(near)


def _publisher_killed(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """A publisher dies in the middle of a stream, and another takes its place."""
    scene, counted = watched.scene, watched.scene.counted
    topic, msgtype = scene.inputs[counted]
    file = watched.player.folder / 'messages'
    file.write_bytes(as_file([serialise(scene.message(i)) for i in range(20)]))
    for _ in amount.counted():
        watched.settle(0.1)
        first = scene.stamp(watched.index)
        command = [sys.executable, '-m', 'benchmarks.soak_publisher', str(file), topic, msgtype]
        with subprocess.Popen(
            [*command, str(first), '20'],
            env={**os.environ, **environment(watched.player.domain)},
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
        ) as publisher:
            heard: list[Handled] = []
            end = time.monotonic() + _PATIENCE
            try:
                while len(heard) < _FROM_ANOTHER:
                    if time.monotonic() > end:
                        raise LiveNodeError(f'{scene.node} does not hear a new publisher')
                    with suppress(_Silent):
                        heard.append(watched.answer(0.5))
            finally:
                publisher.kill()
        heard += watched.settle(0.5)
        outcome.times += 1
        newest = max(handled.stamp_ns for handled in heard)
        watched.index += 1 + round((newest - first) / STEP_NS)
        if watched.next().faults:
            outcome.fault('a message after that of the publisher is not used')


def _overload(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Messages faster than they can be used: bounded, the newest is used, drops are counted."""
    watched.settle(0.1)
    begin = time.monotonic()
    for _ in range(5):
        watched.next()
    interval = (time.monotonic() - begin) / 5 / _OVERLOAD
    counts = _counts(watched)
    heard: list[Handled] = []
    due = time.monotonic()
    for _ in amount.counted():
        watched.node.publish(watched.scene.counted, watched.scene.message(watched.index))
        watched.index += 1
        outcome.times += 1
        due += interval
        watched.spin(max(due - time.monotonic(), 0.0))
        while watched.node.has_answered:
            heard.append(watched.node.answer('message', _PATIENCE))
    end = time.monotonic() + _PATIENCE
    change: dict[str, int] = {}
    while time.monotonic() < end:
        heard += watched.settle(1.0)
        change = {what: count - counts[what] for what, count in _counts(watched).items()}
        if change['used'] + change['skipped'] == len(heard):
            break
    used = len(heard)
    if heard[-1].stamp_ns != watched.scene.stamp(watched.index - 1):
        outcome.fault('the newest message is not the last that is used')
    if change['received'] != change['used'] + change['skipped'] + change['dropped']:
        outcome.fault(f'counts do not add up: {change}')
    if change['used'] + change['skipped'] != used:
        outcome.lost += change['used'] + change['skipped'] - used
    unheard = outcome.times - change['received']
    outcome.done += f': {used} used, {change["dropped"]} dropped and counted'
    if unheard:
        outcome.done += f', {unheard} not heard'


def _counts(watched: Watched) -> dict[str, int]:
    values = watched.values()
    counted, done = _COUNTED[watched.scene.node]
    names = {'received': 'received', 'used': done, 'skipped': 'skipped', 'dropped': 'dropped'}
    return {what: int(values[f'{counted} {name}']) for what, name in names.items()}


_COUNTED = {
    'filter_node': ('images', 'tracked'),
    'smoother_node': ('mixtures', 'smoothed'),
    'bme_node': ('images', 'predicted'),
}


def _clock(watched: Watched, amount: Amount, outcome: Outcome) -> None:
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
        handled = watched.send(watched.scene.counted, stamped(watched.scene.message(0), stamp))
        outcome.times += 1
        outcome.refused += bool(handled.faults)
        if handled.stamp_ns != stamp:
            outcome.fault(f'answered {handled.stamp_ns}, wanted {stamp}')
    watched.values()
    watched.player.node.destroy_publisher(clock)
    watched.set(reset_on_time_jump=True, use_sim_time=False)
    watched.anew()


def _two_publishers(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """A second publisher an hour behind: its messages are skipped, none of the first is."""
    scene, player = watched.scene, watched.player
    topic, msgtype = scene.inputs[scene.counted]
    other = player.node.create_publisher(player.classes[msgtype], topic, player.reliable)
    watched.set(reset_on_time_jump=False)
    end = time.monotonic() + _PATIENCE
    while not other.get_subscription_count() and time.monotonic() < end:
        watched.spin(0.05)
    for number in amount.counted():
        behind = scene.stamp(watched.index) - 3600 * 10**9
        stamp = behind if number % 2 else scene.stamp(watched.index - 1)
        other.publish(serialise(stamped(scene.message(watched.index), stamp)))
        if not watched.answer(_PATIENCE).faults:
            outcome.fault('a message that is older than the last is used')
        outcome.refused += 1
        if watched.next().faults:
            outcome.lost += 1
        outcome.times += 2
    watched.set(reset_on_time_jump=True)
    player.node.destroy_publisher(other)


def _bytes(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Damaged bytes on every topic and in every service; each is answered."""
    rng = np.random.default_rng(0)
    valid = {source: serialise(message) for source, message in watched.scene.valid().items()}
    sources = list(valid)
    for _ in amount.counted():
        chosen = int(rng.integers(0, len(sources) + 1))
        outcome.times += 1
        if chosen == len(sources):
            outcome.refused += not _asked(watched, rng)
            continue
        source = sources[chosen]
        watched.node.publish_bytes(source, damaged(valid[source], rng))
        try:
            handled = watched.answer(_SHORT)
        except _Silent:
            outcome.fault(f'no answer to damaged bytes on {source}')
            continue
        outcome.refused += bool(handled.faults)
    watched.anew()


def _asked(watched: Watched, rng: np.random.Generator) -> bool:
    """Whether the service of a node takes a damaged request."""
    from builtin_interfaces.msg import Time
    from hmt_msgs.srv import PredictPose, Reset, SmoothWindow
    from rclpy.serialization import deserialize_message

    scene = watched.scene
    if scene.node == 'smoother_node':
        times = [
            Time(
                sec=int(rng.choice([0, 10**9, 2**31 - 1, -1])), nanosec=int(rng.integers(0, 2**32))
            )
            for _ in range(2)
        ]
        return bool(
            watched.node.call(
                SmoothWindow, 'smooth_window', from_time=times[0], to_time=times[1]
            ).success
        )
    valid = scene.others[PREDICTION] if scene.node == 'filter_node' else scene.message(0)
    msgtype = valid.__msgtype__
    try:
        data = canonical(damaged(serialise(valid), rng), msgtype)
        message = deserialize_message(data, watched.player.classes[msgtype])
    except Exception:  # noqa: BLE001
        # Not even a client could send it.
        return False
    if scene.node == 'filter_node':
        return bool(watched.node.call(Reset, 'reset', initial=message).success)
    return bool(watched.node.call(PredictPose, 'predict_pose', compressed_image=message).success)


def _killed(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Killed while it computes: what it had answered is there; the next one takes over."""
    rng = np.random.default_rng(0)
    for _ in amount.counted():
        begin = time.monotonic()
        for _ in range(3):
            watched.next()
        one = (time.monotonic() - begin) / 3
        watched.node.publish(watched.scene.counted, watched.scene.message(watched.index))
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


def _shut_down(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """From every state; then it ends as the interrupt key wants."""
    for number in amount.counted():
        for transition in ((), (_DEACTIVATE,), (_DEACTIVATE, _CLEANUP))[number % 3]:
            watched.change(transition)
        state = watched.state()
        if not watched.change(_SHUTDOWN[state]) or watched.state() != _STATES['finalized']:
            outcome.fault(f'can not be shut down in state {state}')
        for transition in (1, 2, 3, 4):
            outcome.refused += not watched.change(transition)
        outcome.times += 1
        watched.node.stop_well()
        watched.restart()
    watched.anew()


# What is said of it, the case, and how often it is done where transitions are made once.
_CASES: tuple[tuple[str, Case, float], ...] = (
    ('transitions of the lifecycle in every order', _transitions, 1.0),
    ('parameters changed while it runs', _parameters, 2.0),
    ('stamps and /clock that jump', _clock, 1.0),
    ('a second publisher, an hour behind', _two_publishers, 0.25),
    ('damaged bytes on topics and in services', _bytes, 10.0),
    ('its publisher killed and replaced', _publisher_killed, 0.02),
    (f'messages at {_OVERLOAD:g} times its rate', _overload, 2.5),
    ('shut down in every state, started again', _shut_down, 0.015),
    ('killed while it computes, started again', _killed, 0.02),
)


def _ignored(topic: str, stamp: int, data: bytes) -> None:
    """That it has come is enough."""


def replay(amount: Amount) -> Iterator[Outcome]:
    """A node, or the recorder itself, is killed in the middle of a bag, and all is done again."""
    with TemporaryDirectory(prefix='hmt_ros.') as folder:
        root = Path(folder)
        whole = root / 'whole'
        code, said = _replayed(whole)
        outcomes = [
            Outcome('replay --live', 'a node killed in the middle of a bag, done again'),
            Outcome('replay --live', 'killed itself in the middle of a bag, done again'),
        ]
        for outcome, of_node in zip(outcomes, (True, False), strict=True):
            if code:
                outcome.fault(f'does not work at all: {said}')
                yield outcome
                continue
            expected = (whole / 'whole.mcap').read_bytes()
            for number in amount.part(0.5).counted():
                name = root / f'{number}{of_node:d}' / 'whole'
                name.parent.mkdir()
                outcome.times += 1
                outcome.refused += 1
                _kill_midway(name, outcome, of_node)
                code, said = _replayed(name)
                if code:
                    outcome.fault(f'the second time: {said}')
                elif (name / 'whole.mcap').read_bytes() != expected:
                    outcome.lost += 1
                    outcome.fault('the bag of the second time differs')
            yield outcome


_REPLAY = (
    sys.executable, '-m', 'hmt_ros', 'replay', str(CLIP), '--subject', str(CLIP / 'subject.yaml'),
    '--background', str(CLIP / 'background.png'), '--live', '--quiet', '--no-smoother',
    '--set', 'max_hypotheses=2', '--set', 'candidates=4', '--set', 'combinations=16',
)  # fmt: skip


def _replayed(target: Path) -> tuple[int, str]:
    """Exit code and last line of a replay."""
    found = subprocess.run(
        [*_REPLAY, '-o', str(target)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return found.returncode, ' '.join(found.stderr.split())


def _kill_midway(target: Path, outcome: Outcome, of_node: bool) -> None:
    """Kills a replay, or its node, when a part of the bag is there."""
    with subprocess.Popen(
        [*_REPLAY, '-o', str(target)], cwd=ROOT, stderr=subprocess.PIPE, text=True
    ) as process:
        end = time.monotonic() + _PATIENCE
        while not (begun := _bytes_in(target.parent)) and time.monotonic() < end:
            time.sleep(0.05)
        children = _children(process.pid)
        if not begun or not children:
            outcome.fault('the replay does not begin')
        for killed in children if of_node else [process.pid]:
            os.kill(killed, signal.SIGKILL)
        _, said = process.communicate()
        if of_node:
            lines = said.strip().splitlines()
            if process.returncode != 1 or len(lines) != 1:
                outcome.fault(f'exit code {process.returncode}: {" ".join(lines)[:150]}')
            if left := sorted(path.name for path in target.parent.iterdir()):
                outcome.fault(f'left behind: {left[0]}')
        if target.exists():
            outcome.fault('a bag that is not whole is in its place')
        end = time.monotonic() + _PATIENCE
        while any(Path(f'/proc/{child}').exists() for child in children):
            if time.monotonic() > end:
                outcome.fault('a node outlives its replay')
                for child in children:
                    os.kill(child, signal.SIGKILL)
                return
            time.sleep(0.1)


def _bytes_in(folder: Path) -> int:
    """Size of what is there of bags, but for what stands at the begin of each."""
    begun = 0
    for path in folder.rglob('*.mcap'):
        with suppress(FileNotFoundError):
            begun = max(begun, path.stat().st_size)
    return begun if begun > _BEGUN else 0


def _children(process: int) -> list[int]:
    """Processes that a process has started."""
    tasks = Path(f'/proc/{process}/task').glob('*/children')
    return [int(child) for task in tasks for child in task.read_text('ascii').split()]
