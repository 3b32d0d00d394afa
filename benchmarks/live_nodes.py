"""The cases of the benchmark `live`, and the nodes and the camera of each as processes."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.live_clips import LARGE, PEOPLE, VISIT
from hmt_ros.app.replay.live_node import LiveNode, NodeProcess
from hmt_ros.app.replay.options import BME, FILTER, SMOOTHER
from hmt_ros.app.replay.player import LiveNodeError, Player, environment
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.image_inputs import KEYPOINTS
from hmt_ros.sessions.keypoints_session import KeypointsParameters
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters

GLANCE = 5.0  # interval between two checks of the memory, s
PERSON, PEOPLE_NODE, DETECTOR = 'person_node', 'people_node', 'keypoints_node'


@dataclass(frozen=True)
class Case:
    """Configuration of the nodes in a run.

    Attributes:
        what: description.
        clip: name of the clip, see `benchmarks.live_clips`.
        transport: image transport.
        keypoints: whether keypoints are given; then there are no BME experts.
        detector: whether MediaPipe detects the keypoints, on the same machine.
        together: whether the nodes run in one process.
        smoothed: whether the smoother runs.
        keep_out: whether a robot subscribes to the keep-out space.
        gravity: whether gravity is given.
        sampled: whether the process is profiled, see `benchmarks.sampling`.
    """

    what: str
    clip: str = 'dance'
    transport: str = 'raw'
    keypoints: bool = False
    detector: bool = False
    together: bool = False
    smoothed: bool = True
    keep_out: bool = False
    gravity: bool = False
    sampled: bool = False

    @property
    def people(self) -> int:
        """Number of people tracked by `people_node`; 0 if it is not used."""
        kind, _, number = self.clip.partition(' ')
        return int(number) if kind == PEOPLE else 0


CASES = {
    'newest': Case('processes apart: newest complete image'),
    'compressed': Case('JPEG', transport='compressed'),
    'gravity': Case('gravity given', gravity=True),
    'keypoints': Case('images and keypoints', keypoints=True),
    'together': Case('one process: newest complete image', together=True),
    'together, keep_out': Case(
        'one process: the same, keep_out listened to', together=True, keep_out=True
    ),
    'together, filter': Case(
        'one process: filter and experts alone', together=True, smoothed=False
    ),
    'together, keypoints': Case('one process: images and keypoints', keypoints=True, together=True),
    'together, keypoints, filter': Case(
        'one process: the same, filter alone', keypoints=True, together=True, smoothed=False
    ),
    'together, detector': Case(
        'one process: images and MediaPipe', keypoints=True, detector=True, together=True
    ),
    'sampled': Case('live, images', together=True, sampled=True),
    'sampled, keypoints': Case(
        'live, images and keypoints', keypoints=True, together=True, sampled=True
    ),
    'large': Case('processes apart: 1280x720, 15 images a second', clip=LARGE),
    'visit': Case('one process: images', clip=VISIT, together=True, keep_out=True),
    'visit, keypoints': Case(
        'one process: images and MediaPipe',
        clip=VISIT,
        keypoints=True,
        detector=True,
        together=True,
        keep_out=True,
    ),
    **{
        f'people {count}': Case(f'people_node: {count}', clip=f'{PEOPLE} {count}', keypoints=True)
        for count in (1, 2, 4)
    },
}


def start_nodes(player: Player, opened: ExitStack, clip: Path, case: Case) -> list[LiveNode]:
    """Starts the nodes as the launch file does; the tracking node is the first."""
    from hmt_ros.nodes.person_node import used_of_each_other

    images = {
        'image_transport': case.transport,
        'background_file': str(clip / 'background.png'),
    }
    detector = {DETECTOR: KeypointsParameters(image_transport=case.transport)}
    names = (
        FILTER,
        *((SMOOTHER,) if case.smoothed else ()),
        DETECTOR if case.detector else KEYPOINTS if case.keypoints else BME,
    )
    used = used_of_each_other(names)
    chosen: dict[str, Any]
    if case.people:
        chosen = {PEOPLE_NODE: replace(PeopleParameters(), **images)}
    else:
        given: dict[str, Any] = {'use_keypoints': True} if case.keypoints else {}
        if case.gravity:
            given['gravity'] = (0.0, 1.0, 0.0)
        chosen = {FILTER: replace(FilterParameters(), **images, **used[FILTER] | given)}
        if case.smoothed:
            chosen[SMOOTHER] = SmootherParameters()
        if case.detector:
            chosen |= detector
        elif not case.keypoints:
            chosen[BME] = replace(BmeParameters(), **images | used[BME])
    process = None
    if case.together:
        module = 'benchmarks.sampled_nodes' if case.sampled else f'hmt_ros.nodes.{PERSON}'
        process = NodeProcess(player, opened, PERSON, module, tuple(chosen))
    nodes = [
        LiveNode(
            player, opened, name, parameters, inputs={}, topics={}, within=process, write=_ignored
        )
        for name, parameters in chosen.items()
    ]
    if process is not None:
        process.start()
    return nodes


class CameraProcess:
    """The process that publishes the clip."""

    def __init__(
        self,
        opened: ExitStack,
        domain: int,
        clip: Path,
        transport: str,
        images: int,
        more: Sequence[str] = (),
        *,
        subscribers: int,
        rate: float,
    ) -> None:
        command = [sys.executable, '-m', 'benchmarks.camera', str(clip), transport]
        self._process = subprocess.Popen(
            [*command, f'{rate:g}', str(images), str(subscribers), *more],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **environment(domain)},
            start_new_session=True,
        )
        opened.callback(self._process.kill)
        self.latest_ns = 0

    def begin(self, player: Player) -> tuple[int, int]:
        """Starts the clip; returns the shift of its timestamps and its start time, ns."""
        self._say()
        assert self._process.stdout is not None
        shift, start = self._process.stdout.readline().split()
        return int(shift), int(start)

    def ended(self) -> bool:
        """Whether all images have been published."""
        assert self._process.stdout is not None
        if not select.select([self._process.stdout], [], [], 0)[0]:
            return False
        self.latest_ns = int(self._process.stdout.readline())
        return True

    def spin(
        self,
        player: Player,
        done: Callable[[], bool],
        seconds: float,
        every: Callable[[], None] = lambda: None,
    ) -> None:
        """Listens until a condition holds; calls `every` every few seconds.

        Raises:
            LiveNodeError: it takes too long, or the camera has ended.
        """
        end, then = time.monotonic() + seconds, time.monotonic() + GLANCE
        while not done():
            player.executor.spin_once(timeout_sec=0.1)
            if time.monotonic() > then:
                then += GLANCE
                every()
            if self._process.poll() is not None:
                raise LiveNodeError(f'the camera ended with code {self._process.returncode}')
            if time.monotonic() > end:
                raise LiveNodeError(f'no end of the clip, or no track, within {seconds:.0f} s')

    def _say(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(b'\n')
        self._process.stdin.flush()


def cpu_seconds(node: LiveNode) -> float:
    """Processor time used by the process of a node, s."""
    fields = Path(f'/proc/{node.process.pid}/stat').read_text('utf-8').rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def memory(node: LiveNode, part: str = 'Pss') -> float:
    """Memory of the process of a node, MB.

    Args:
        part: 'Pss', including its share of memory shared with other processes, or 'Pss_Anon',
            without files, so that other processes do not change it.
    """
    text = Path(f'/proc/{node.process.pid}/smaps_rollup').read_text('utf-8')
    (line,) = (line for line in text.splitlines() if line.startswith(f'{part}:'))
    return int(line.split()[1]) / 1e3


def _ignored(topic: str, stamp: int, data: bytes) -> None:
    """Ignored, because results are received elsewhere."""
