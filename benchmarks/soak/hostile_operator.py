"""Soak test with a hostile operator, who calls a node's services and publishes on its topics.

Meanwhile the node gets images, each after the previous one is answered; long gaps between answers
show that the operator can stop it.
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.soak.hostile_bags import YAML_BOMBS
from benchmarks.soak.hostile_file import CONTROL, DEEP, DIGITS, Hostile
from benchmarks.soak.hostile_files import zeros_archive
from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.scenes import STEP_NS, stamped
from benchmarks.soak.watched_node import Watched
from hmt_ros.app.replay.player import LiveNodeError
from hmt_ros.sessions.declared_parameters import declared_parameters
from hmt_ros.sessions.image_inputs import KEYPOINTS, MASK

# Maximum time to answer a call, and maximum excess over the usual time to answer an image, s.
ANSWER, GAP = 1.0, 0.5
# Time for a call before the node counts as lost, duration of a flood, maximum gap in a flood, s;
# maximum characters of a reason.
_LOST, _FLOOD, _FLOOD_GAP, _CHARACTERS = 40.0, 2.0, 2.0, 300
_TOKEN = 'xylophone4711'
_PASSWORDS = Path('/etc/passwd')


def _while(amount: Amount) -> float:
    """Duration of a flood or of a quiet phase, s."""
    return min(_FLOOD, max(0.3, 0.02 * amount.times), amount.seconds / 4)


class _Fed:
    """A node that gets its messages one by one, during other actions on it.

    Attributes:
        gap: maximum time without an answer, s.
    """

    def __init__(self, watched: Watched) -> None:
        self.watched = watched
        # The node must know the client of its service before times are measured.
        watched.begin_to_set()
        self.begin()

    def begin(self) -> None:
        """Restarts the measurement of gaps."""
        self._sent = False
        self._last = time.monotonic()
        self.gap = 0.0

    def until(self, done: Callable[[], bool], seconds: float) -> bool:
        """Feeds the node until a condition holds; returns whether it held in time."""
        end = time.monotonic() + seconds
        while not done():
            if time.monotonic() > end:
                return False
            self.step()
        return True

    def step(self) -> None:
        """Sends the next message if the last is answered, and receives answers."""
        watched, counted = self.watched, self.watched.scene.session.COUNTED
        watched.check_alive()
        if not self._sent:
            watched.node.publish(counted, watched.scene.message(watched.index))
            watched.index += 1
            self._sent = True
        watched.player.executor.spin_once(timeout_sec=0.01)
        now = time.monotonic()
        while watched.node.has_answered:
            handled = watched.answer(ANSWER)
            if handled.source == counted:
                self._sent, self._last = False, now
        self.gap = max(self.gap, now - self._last)

    def usual_gap(self, seconds: float) -> float:
        """The maximum gap during a quiet phase."""
        self.until(lambda: False, seconds)
        usual = self.gap
        self.begin()
        return usual

    def judge(self, usual: float, outcome: Outcome, what: str, most: float = GAP) -> None:
        """Compares the gap with the usual one."""
        if self.gap > usual + most:
            outcome.fault(f'{what}: no image is answered for {self.gap:.1f} s, else {usual:.1f} s')


def files_in_parameters(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Sets file parameters to odd files; reasons must not reveal content, nor calls block."""
    scene = watched.scene
    names = [
        parameter.name
        for parameter in declared_parameters(scene.parameters)
        if isinstance(parameter.default, str) and parameter.name in scene.session.CHECKED
    ]
    usual_values = dict(zip(names, watched.get(names), strict=True))
    # By default a node is allowed to read the working folder and the home folder.
    with TemporaryDirectory(prefix='.hmt_ros.', dir=Path.home()) as folder:
        values = list(islice(_odd_values(Path(folder)), amount.times))
        given = [(name, value) for value in values for name in names]
        fed = _Fed(watched)
        usual = fed.usual_gap(_while(amount))
        for number in Amount(min(len(given), amount.times), amount.seconds).counted():
            name, value = given[number]
            done, why = _set(fed, name, value, outcome)
            outcome.times += 1
            outcome.refused += not done
            if done:
                _set(fed, name, usual_values[name], outcome)
            elif not why or len(why) > _CHARACTERS or not why.isprintable():
                outcome.fault(f'{name} is refused with {why[:80]!r}, {len(why)} characters')
            _look_for_content(why, value, f'the reason of {name}', outcome)
            fed.judge(usual, outcome, f'{name} = {_short(value)}')
            fed.gap = 0.0
        fed.until(lambda: False, _while(amount))
        said = f'{watched.node.output()} {watched.values()}'
        _look_for_content(said, '', 'the log or the diagnostics', outcome)


def _set(fed: _Fed, name: str, value: str, outcome: Outcome) -> tuple[bool, str]:
    """Sets a parameter while the node is fed."""
    future = fed.watched.begin_to_set(**{name: value})
    if not fed.until(future.done, ANSWER):
        outcome.fault(f'{name} = {_short(value)}: no answer after {ANSWER:g} s')
        if not fed.until(future.done, _LOST):
            raise LiveNodeError(f'{name} = {_short(value)} is never answered')
    (result,) = future.result().results
    return bool(result.successful), str(result.reason)


def _short(value: str) -> str:
    return repr(value.rpartition('/')[2][:40])


def _look_for_content(text: str, value: str, where: str, outcome: Outcome) -> None:
    words = re.split(r'[:\s]', _PASSWORDS.read_text('utf-8')) if _PASSWORDS.is_file() else []
    content = [_TOKEN, *(word for word in words if len(word) > 11 and word not in value)]
    if found := next((word for word in content if word in text), ''):
        outcome.fault(f'{where} tells content of {_short(value)}: {found}')


def _odd_values(folder: Path) -> Iterator[str]:
    """Paths of files, of other things, and of endless ones; the worst last."""
    texts = {
        'key.yaml': f'keypoints: {{{_TOKEN}: [1, 2]}}\nstamp_ns: {_TOKEN}\n',
        'value.yaml': f'stamp_ns: {_TOKEN}\nsigma_px: 1\nkeypoints: {{}}\n',
        'name.yaml': f'name: {_TOKEN}\nsegments: [{{name: {_TOKEN}, parent: x}}]\n',
        'extra.yaml': f'{_TOKEN}: 1\n',
        'text.yaml': f'{_TOKEN} {_TOKEN}: [{_TOKEN}\n',
        'tag.yaml': f'!{_TOKEN} 1\n',
        'alias.yaml': f'*{_TOKEN}\n',
        'list.yaml': '- 1\n' * 250_000,
        'lists.yaml': '[' + '[],' * 300_000 + '1]',
        'digits.yaml': f'stamp_ns: {DIGITS}',
        'deep.yaml': DEEP,
        'bomb.yaml': YAML_BOMBS['aliases'],
        'x.json': f'{{"{_TOKEN}": [1]}}',
        'deep.npz': DEEP,
        'text.npz': f'PK{_TOKEN}',
        'x.png': _TOKEN,
        'bomb.npz': partial(zeros_archive, 600_000_000),
    }
    # Links, pipes, devices, folders and sparse files: reading one may never end.
    places: dict[str, Callable[[Path], object]] = {
        'sparse.yaml': lambda path: os.truncate(os.open(path, os.O_WRONLY | os.O_CREAT), 2**33),
        'circle.yaml': lambda path: path.symlink_to(path),
        'link.yaml': lambda path: path.symlink_to(_PASSWORDS),
        'folder': Path.mkdir,
        'zeros.yaml': lambda path: path.symlink_to('/dev/zero'),
        'pipe.yaml': os.mkfifo,
    }
    yield from ('/etc/passwd', '/etc/shadow', '/etc/hostname', '../../../../etc/passwd')
    yield from ('/proc/self/environ', '/proc/self/mem', '/proc/self/fd/0', '~root/.bashrc')
    yield from (CONTROL, '/x' * 50_000)
    files = [Hostile(name, content) for name, content in texts.items()]
    files += [Hostile(name, write=write) for name, write in places.items()]
    for file in files:
        file.make(folder / file.name)
        yield str(folder / file.name)


def floods(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Floods the node with calls and messages; images and calls must still be answered."""
    fed = _Fed(watched)
    usual = fed.usual_gap(_while(amount))
    rng = np.random.default_rng(0)
    pending: list[Any] = []

    def garbage() -> None:
        source = list(watched.scene.inputs)[int(rng.integers(0, len(watched.scene.inputs)))]
        watched.node.publish_bytes(source, rng.bytes(int(rng.integers(1, 2000))))

    def calls() -> None:
        pending.append(watched.begin_to_set(queue_size=int(rng.integers(-1, 9))))

    def inputs() -> None:
        for source, message in watched.scene.prelude:
            watched.node.publish(source, message)

    for what, act in (('parameters', calls), ('garbage', garbage), ('inputs', inputs)):
        fed.begin()
        due = time.monotonic()
        end = due + _while(amount)
        while time.monotonic() < end:
            # At most a thousand per second, each followed by listening to answers.
            if time.monotonic() >= due:
                act()
                due += 1e-3
                outcome.times += 1
            else:
                fed.step()
        fed.judge(usual, outcome, f'a flood of {what}', _FLOOD_GAP)
        begin = time.monotonic()
        watched.settle(0.2)
        if not fed.until(watched.begin_to_set(queue_size=5).done, max(ANSWER, _LOST)):
            raise LiveNodeError(f'after a flood of {what} no call is answered')
        if (late := time.monotonic() - begin) > ANSWER + 10 * GAP:
            outcome.fault(f'after a flood of {what} a call is answered after {late:.1f} s')
    watched.begin_again()


def stray_stamps(watched: Watched, amount: Amount, outcome: Outcome) -> None:
    """Sends impossible timestamps in messages of every source, and sets the clock back."""
    scene, counted = watched.scene, watched.scene.session.COUNTED
    inputs = [source for source in (KEYPOINTS, MASK) if source in scene.others]
    watched.set(**{f'use_{source}': True for source in inputs})

    def refused(count: int, shift_ns: int = 0) -> int:
        found = 0
        for _ in range(count):
            stamp = scene.stamp(watched.index) + shift_ns
            watched.index += 1
            for source in inputs:
                watched.send(source, stamped(scene.others[source], stamp))
            found += bool(watched.send(counted, stamped(scene.message(0), stamp)).faults)
        return found

    def begin() -> None:
        watched.set(reset_on_time_jump=True)
        watched.begin_again()
        watched.set(reset_on_time_jump=False)

    begin()
    refused(3)
    # Only sources whose messages have timestamps.
    sources = [
        source
        for source in (*scene.others, counted)
        if any(hasattr(_any_message(scene, source), x) for x in ('header', 'transforms'))
    ]
    strays = ((0, 4_294_967_295), (3600, 0), (-3600, 0), (10**8, 0), (-(10**8), 10**9))
    given = [(source, stray) for stray in strays for source in sources]
    for number in Amount(min(len(given), amount.times), amount.seconds / 2).counted():
        source, (seconds, nanoseconds) = given[number]
        stamp = scene.stamp(watched.index)
        message = _with_stamp(_any_message(scene, source), stamp // 10**9 + seconds, nanoseconds)
        watched.send(source, message)
        outcome.times += 1
        if lost := refused(5):
            outcome.lost += lost
            what = f'{seconds:+} s and {nanoseconds} ns'
            outcome.fault(f'{lost} of 5 images are refused after a {source} of {what}')
            begin()
    for back in (600, 2):
        refused(3)
        outcome.times += 1
        lost = refused(30, -back * 10**9)
        if lost > 10**9 // STEP_NS:
            outcome.fault(f'{lost} of 30 images are refused after a clock went back by {back} s')
        begin()
    watched.set(reset_on_time_jump=True, **{f'use_{source}': False for source in inputs})
    watched.begin_again()


def _any_message(scene: Any, source: str) -> Any:
    return scene.others.get(source) or scene.message(0)


def _with_stamp(message: Any, seconds: int, nanoseconds: int) -> Any:
    """The message with an arbitrary timestamp."""
    if hasattr(message, 'transforms'):
        return replace(
            message, transforms=[_with_stamp(x, seconds, nanoseconds) for x in message.transforms]
        )
    stamp = replace(message.header.stamp, sec=seconds, nanosec=nanoseconds)
    return replace(message, header=replace(message.header, stamp=stamp))
