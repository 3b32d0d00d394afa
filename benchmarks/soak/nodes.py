"""Soak test of nodes that run in their own processes and are fed over DDS."""

from __future__ import annotations

import itertools
import signal
import time
from array import array
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np

from benchmarks.machine import forget_peak, peak_memory, resident_memory
from benchmarks.mutations import damaged
from benchmarks.soak.hostile import write_video
from benchmarks.soak.hostile_operator import ANSWER, files_in_parameters, floods, stray_stamps
from benchmarks.soak.outcome import Amount, Outcome, place
from benchmarks.soak.scenes import STEP_NS, scenes, stamped
from benchmarks.soak.watched_node import PATIENCE, SHORT, Silent, Watched
from hmt_ros.app.replay.live_node import NodeProcess
from hmt_ros.app.replay.player import LiveNodeError, Player
from hmt_ros.sessions.declared_parameters import DeclaredParameter, declared_parameters
from hmt_ros.sessions.handled import Handled
from hmt_ros.sessions.image_inputs import PREDICTION
from msg_tools.files.error_line import error_line
from msg_tools.messages.cdr import canonical, serialise

# Message rate relative to what the node can process.
OVERLOAD = 5.0
# Next state by state and transition; states are 1 unconfigured, 2 inactive, 3 active.
_CONFIGURE, _CLEANUP, _ACTIVATE, _DEACTIVATE = 1, 2, 3, 4
_FOLLOWING = {
    (1, _CONFIGURE): 2,
    (2, _CLEANUP): 1,
    (2, _ACTIVATE): 3,
    (3, _DEACTIVATE): 2,
}


def transitions(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Tries every transition in every state, then random ones; invalid ones must be refused."""
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
            watched.begin_again()
    while state != 3:
        watched.change({1: _CONFIGURE, 2: _ACTIVATE}[state])
        state = watched.state()
    watched.begin_again()


def killed(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Kills and restarts the node while it computes; all announced messages must arrive."""
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
        watched.begin_again()


def _has_come(watched: Watched) -> bool:
    """Whether all messages named by an answer have arrived from a node that has ended."""
    try:
        watched.node.answer('message', 0.0)
    except LiveNodeError:
        return False
    return True


def changed_parameters(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Sets random parameters, valid or not, between messages; accepted ones must be in effect."""
    rng = np.random.default_rng(0)
    declared = [p for p in declared_parameters(watched.scene.parameters) if p.effect != 'at launch']
    names = [parameter.name for parameter in declared]
    usual = dict(zip(names, watched.get(names), strict=True))
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
        if _plain(found) != _plain(known[chosen.name]):
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
    changed = {name: usual[name] for name in usual if _plain(known[name]) != _plain(usual[name])}
    if not changed:
        return
    done, why = watched.set(**changed)
    if not done:
        outcome.fault(f'the usual values are refused: {why}')
    known.update(usual)


def _plain(value: Any) -> Any:
    """A value for comparison, because ROS returns lists as arrays."""
    return list(value) if isinstance(value, list | array | tuple) else value


def _any_value(parameter: DeclaredParameter, rng: np.random.Generator) -> Any:
    """Random value of a parameter: near the default, beyond a limit, or of another type."""
    default, kind = parameter.default, rng.random()
    if kind < 0.1:
        wrong: tuple[Any, ...] = ('', 'pigeon', -1, 2**40, float('nan'), True, [1, 2], [b'x'])
        return wrong[int(rng.integers(0, len(wrong)))]
    if isinstance(default, bool):
        return bool(rng.random() < 0.5)
    if isinstance(default, tuple):
        lists: tuple[Any, ...] = ([], [0.0, 1.0, 0.0], [0, 1, 0], [0.0, 0.0, 0.0], [1.0], ['down'])
        return lists[int(rng.integers(0, len(lists)))]
    if isinstance(default, str):
        return ('', default, 'nowhere', default * 2, '/dev/null', '\n')[int(rng.integers(0, 6))]
    low, high = parameter.limits or (-1e9, 1e9)
    if kind < 0.2:
        value = (low - 1, high + 1, -1e300, np.inf, -np.inf)[int(rng.integers(0, 5))]
        whole = isinstance(default, int) and np.isfinite(value)
        return int(max(value, -(2.0**63))) if whole else value  # the minimum in a message
    near = float(np.clip(default * np.exp2(rng.uniform(-1.0, 1.0)), low, high))
    return near if isinstance(default, float) else round(near)


def jumping_clock(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Lets timestamps and the simulation clock jump; every message must be answered."""
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
    watched.begin_again()


def overload(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Sends messages too fast; the newest must be used, and dropped ones counted."""
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

    def adds_up() -> bool:
        told = change['used'] + change['skipped'] + change['dropped']
        # An image in which people_node tracks nobody is in none of these counts.
        nobody = watched.scene.node == 'people_node' and not change['used']
        return told == change['received'] or (nobody and told < change['received'])

    while time.monotonic() < end:
        heard += watched.settle(1.0)
        change = {what: count - counts[what] for what, count in _counts(watched).items()}
        # Diagnostics may be older than the answer.
        if change['received'] == len(heard) and adds_up():
            break
    if heard[-1].stamp_ns != watched.scene.stamp(watched.index - 1):
        outcome.fault('the newest message is not the last that is used')
    if not adds_up():
        outcome.fault(f'counts do not add up: {change}')
    # Dropped messages are answered, too.
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


def damaged_bytes(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Sends damaged bytes to every topic and service; each must be answered."""
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
        # An empty message, which no ROS publisher can send, would block a reliable topic in DDS.
        watched.node.publish_bytes(source, damaged(valid[source], rng) or b'\0')
        try:
            handled = watched.answer(SHORT)
        except Silent:
            outcome.fault(f'no answer to damaged bytes on {source}')
            continue
        outcome.refused += bool(handled.faults)
    watched.begin_again()


def _asked(watched: Watched, rng: np.random.Generator) -> bool:
    """Whether the service of a node accepts a damaged request."""
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
    tracks = scene.node in ('filter_node', 'people_node')
    valid = scenes()['filter_node'].others[PREDICTION] if tracks else scene.message(0)
    msgtype = valid.__msgtype__
    try:
        data = canonical(damaged(serialise(valid), rng), msgtype)
        message = deserialize_message(data, watched.player.classes[msgtype])
    except Exception:  # noqa: BLE001
        # No client could send such a request.
        return False
    if tracks:
        return bool(watched.node.call(Reset, 'reset', initial=message).success)
    return bool(watched.node.call(PredictPose, 'predict_pose', compressed_image=message).success)


Case = Callable[[Watched, Amount, Outcome], None]

# Description, function and repetitions of each case, the latter relative to transitions.
CASES: tuple[tuple[str, Case, float], ...] = (
    ('transitions of the lifecycle in every order', transitions, 1.0),
    ('parameters changed while it runs', changed_parameters, 2.0),
    ('stamps and /clock that jump', jumping_clock, 1.0),
    ('damaged bytes on topics and in services', damaged_bytes, 10.0),
    (f'messages at {OVERLOAD:g} times its rate', overload, 2.5),
    ('stamps that cannot be, a clock set back', stray_stamps, 1.0),
    ('floods of calls and messages', floods, 1.0),
    ('odd files as parameters', files_in_parameters, 1.0),
    ('killed while it computes, started again', killed, 0.02),
)


# Nodes without a scene, and their command-line arguments. They stay unconfigured if a detector or
# hri_msgs is missing.
_ALONE = {
    'camera_node': ('VIDEO', '--fov', '60', '--ros-args', '-p', 'loop:=true'),
    'keypoints_node': (),
    'hri_node': (),
}
_USUAL_GAP = 2.0
# Minimum duration of a case, s.
_LEAST = 2.0


def alone(name: str, amount: Amount) -> Outcome:
    """Sends strange parameters to one node; it must answer, keep running and publish images."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter import Parameter
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Image

    outcome = Outcome(name, 'strange parameters, in a process of its own')
    rng = np.random.default_rng(0)
    with ExitStack() as opened:
        player = Player(opened)
        video = player.folder / 'video.avi'
        write_video(video)
        words = [str(video) if word == 'VIDEO' else word for word in _ALONE[name]]
        process = NodeProcess(player, opened, name, f'hmt_ros.nodes.{name}', words)
        arrivals: list[float] = []
        player.node.create_subscription(
            Image,
            '/image_raw',
            lambda _: arrivals.append(time.monotonic()),
            qos_profile_sensor_data,
        )
        client = player.node.create_client(SetParameters, f'/{name}/set_parameters')
        process.start()

        def wait(done: Callable[[], bool], seconds: float) -> bool:
            end = time.monotonic() + seconds
            while not done() and time.monotonic() < end:
                player.executor.spin_once(timeout_sec=0.02)
            return done()

        if not wait(client.service_is_ready, PATIENCE):
            outcome.fault(f'does not start: {process.output()[-200:]}')
            return outcome
        wait(lambda: len(arrivals) > 5, 2 * _USUAL_GAP)
        before = resident_memory(process.popen.pid)
        del arrivals[:]
        for _ in amount.counted():
            chosen = ('loop', 'rate', 'wait_for', 'detector', 'queue_size', 'x' * 1000)[
                int(rng.integers(0, 6))
            ]
            value = ('/dev/zero', '\x1b[2J', -1, float('nan'), True, ['x'])[int(rng.integers(0, 6))]
            given = [Parameter(chosen, value=value).to_parameter_msg()]
            future = client.call_async(SetParameters.Request(parameters=given))
            outcome.times += 1
            if not wait(future.done, ANSWER):
                outcome.fault(f'{chosen[:20]} = {value!r}: no answer after {ANSWER:g} s')
                continue
            outcome.refused += not future.result().results[0].successful
        gap = max(np.diff(arrivals), default=0.0)
        if gap > _USUAL_GAP:
            outcome.fault(f'no image for {gap:.1f} s')
        outcome.growth_mb = (resident_memory(process.popen.pid) - before) / 1e6
        if 'Traceback' in process.output():
            outcome.fault(f'said {process.output()[-200:]!r}')
        if (code := process.stop()) not in (0, None):
            outcome.fault(f'ended with code {code}')
    return outcome


def nodes(amount: Amount, *, quick: bool = False) -> Iterator[Outcome]:
    """Runs every case with every node; a node is reused for the next case while it is alive."""
    chosen = [scenes()['smoother_node']] if quick else [*scenes().values()]
    by_themselves = () if quick else _ALONE
    end = time.monotonic() + amount.seconds
    left = len(chosen) * len(CASES) + len(by_themselves)
    for scene in chosen:
        with ExitStack() as running:
            watched: Watched | None = None
            # The last case restarts nodes, which costs seconds of processor time.
            for done, case, share in CASES[: -1 if quick else None]:
                outcome = Outcome(scene.title, done)
                try:
                    if watched is None:
                        watched = running.enter_context(Watched(scene))
                        watched.warm_up()
                    # Overtime of a case, and each start, shortens all later cases.
                    seconds = max((end - time.monotonic()) / left, _LEAST)
                    part = Amount(max(1, round(amount.times * share)), seconds)
                    _do(case, watched, part, outcome)
                except Exception as error:  # noqa: BLE001 - reported, and other cases follow
                    known = isinstance(error, LiveNodeError | Silent | TimeoutError)
                    outcome.fault(error_line(error) if known else place(error))
                    running.close()
                    watched = None
                left -= 1
                yield outcome
    for name in by_themselves:
        yield alone(name, Amount(amount.times, max((end - time.monotonic()) / left, _LEAST)))
        left -= 1


def _do(case: Case, watched: Watched, part: Amount, outcome: Outcome) -> None:
    """Runs a case with a node, and checks its memory and its log."""
    process, said = watched.node.process.pid, len(watched.traces())
    forget_peak(process)
    before = resident_memory(process)
    watched.limit(part.seconds)
    case(watched, part, outcome)
    watched.check_alive()
    if watched.node.process.pid == process:
        outcome.growth_mb = max(peak_memory(process) - before, 0.0) / 1e6
        outcome.kept_mb = (resident_memory(process) - before) / 1e6
    for text in watched.traces()[said:]:
        outcome.fault(text)
