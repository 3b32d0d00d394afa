"""CPU time by call stack: samples of all threads of a process.

A sample of a thread has the CPU time that the thread has used since the previous one. Time is
assigned to a node by its session, to a stage of a step by the functions of `benchmarks.stages`, and
for libraries to the calling function of the project.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

from benchmarks.clips import ROOT, table

# Environment variable with the file that a sampled process writes at its end.
PROFILE_FILE = 'HMT_PROFILE_FILE'
# Interval between two samples, s, which must not divide the interval between two images.
PERIOD = 0.0043
PACKAGES = tuple(f'{ROOT / name}{os.sep}' for name in ('hmt_ros', 'msg_tools', 'hmt_learning'))
STEP = ('hmt_ros/tracking/tracker.py', 'step')
NODES = {
    'hmt_ros/sessions/smoother_session.py': 'smoother',
    'hmt_ros/sessions/bme_session.py': 'experts',
    'hmt_ros/sessions/tracking_session.py': 'filter, without steps',
    'hmt_ros/sessions/people_session.py': 'filter, without steps',
    'hmt_ros/sessions/keypoints_session.py': 'detector',
}
IN_STEPS, EXECUTOR, OTHER, REST = 'steps', 'executor of ROS', 'other threads', 'DDS, and unsampled'
# Maximum number of functions in a table.
TOLD = 25

Function = tuple[str, str]  # file and name


class Sample(NamedTuple):
    """Time of a call stack, innermost function first.

    Attributes:
        second: time of the monotonic clock, whole seconds.
        thread: name of the thread.
        stack: functions of the project.
        seconds: CPU time, s.
    """

    second: int
    thread: str
    stack: tuple[Function, ...]
    seconds: float


class StackSampler(AbstractContextManager['StackSampler']):
    """Samples the threads of this process while it is entered."""

    def __init__(self) -> None:
        self._found: Counter[tuple[int, str, tuple[CodeType, ...]]] = Counter()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name='sampler', daemon=True)

    def __enter__(self) -> StackSampler:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _work(self) -> None:
        before: dict[int, float] = {}
        while not self._ended.wait(PERIOD):
            frames, second = sys._current_frames(), int(time.monotonic())
            for thread in threading.enumerate():
                identity = thread.ident
                if thread is self._thread or identity is None:
                    continue
                with suppress(OSError):  # the thread has ended
                    now = time.clock_gettime(time.pthread_getcpuclockid(identity))
                    spent = now - before.get(identity, now)
                    before[identity] = now
                    frame, stack = frames.get(identity), list[CodeType]()
                    while frame is not None:
                        stack.append(frame.f_code)
                        frame = frame.f_back
                    if spent > 0.0:
                        self._found[second, thread.name, tuple(stack)] += spent

    def samples(self) -> list[Sample]:
        """The samples taken."""
        return [
            Sample(second, thread, _of_project(stack), spent)
            for (second, thread, stack), spent in self._found.items()
        ]


def _of_project(stack: Iterable[CodeType]) -> tuple[Function, ...]:
    return tuple(
        (os.path.relpath(code.co_filename, ROOT), code.co_name)
        for code in stack
        if code.co_filename.startswith(PACKAGES)
    )


def write_samples(samples: Iterable[Sample], file: Path) -> None:
    """Writes a file for `read_samples`."""
    file.write_text(json.dumps(list(samples)), 'utf-8')


def read_samples(file: Path) -> list[Sample]:
    """Reads the samples of a process that has ended."""
    return [
        Sample(second, thread, tuple((name, function) for name, function in stack), spent)
        for second, thread, stack, spent in json.loads(file.read_text('utf-8'))
    ]


def profile_of(samples: Iterable[Sample], images: int, cpu_s: float | None = None) -> Any:
    """CPU time per image by node, by stage of a step, and by function outside steps, ms.

    Args:
        cpu_s: CPU time of the whole process, s; None means that of the samples.
    """
    stages = _stages()
    nodes, parts, functions = Counter[str](), Counter[str](), Counter[str]()
    for _, thread, stack, spent in samples:
        ms = 1e3 * spent / images
        if STEP in stack:
            nodes[IN_STEPS] += ms
            parts[next((stages[x] for x in stack if x in stages), 'other')] += ms
            continue
        other = EXECUTOR if thread == 'MainThread' else OTHER
        nodes[next((NODES[file] for file, _ in reversed(stack) if file in NODES), other)] += ms
        if stack:
            functions[':'.join(stack[0])] += ms
    if cpu_s is not None:
        nodes[REST] = max(1e3 * cpu_s / images - nodes.total(), 0.0)
    return {
        'images': images,
        'nodes': dict(nodes),
        'stages': dict(parts),
        'functions': dict(functions.most_common(2 * TOLD)),
    }


def _stages() -> Mapping[Function, str]:
    """Stages of a step by their functions."""
    # Imported here, so that the nodes need no inner modules of the tracker.
    from benchmarks.stages import STAGES

    codes = ((getattr(owner, name).__code__, stage) for owner, name, stage in STAGES)
    return {_of_project([code])[0]: stage for code, stage in codes}


def profiles_as_text(found: Mapping[str, Any], *, markdown: bool = False) -> str:
    """Tables of profiles: nodes, stages, functions."""
    tables = []
    for part, what in (
        ('nodes', 'CPU, ms an image'),
        ('stages', 'a step, by stage'),
        ('functions', 'outside steps, by function'),
    ):
        every = Counter[str]()
        for profile in found.values():
            every.update(profile[part])
        rows = [[what, *found]]
        names = [name for name, _ in every.most_common(TOLD)]
        rows += [
            [name, *(f'{x[part][name]:.2f}' if name in x[part] else '' for x in found.values())]
            for name in names
        ]
        if part != 'functions':
            rows.append(['all', *(f'{sum(x[part].values()):.2f}' for x in found.values())])
        tables.append(table(rows, markdown=markdown))
    return '\n\n'.join(tables)
