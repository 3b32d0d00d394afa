"""live: filter, smoother and BME at the images of a camera that does not wait for them.

A clip of a dancer with known truth is rendered, and replayed offline, where every image is used.
Keypoints are the true joints with the noise of a detector, behind each image.
Then a camera, in a process of its own, shows it to the real nodes at its rate. Latency is
the time from when an image is due at the camera to the arrival of its pose_mixture in another
process; age is how much older a smoothed pose is, when it arrives, than the newest image.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import COMPRESSED, read_messages, table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.nodes import PROFILE
from hmt_ros.app import make_bag
from hmt_ros.app.bag_scores import score_bag
from hmt_ros.app.replay import command as replay
from hmt_ros.app.replay.live_node import LiveNode, NodeProcess
from hmt_ros.app.replay.options import BME, FILTER, SMOOTHER
from hmt_ros.app.replay.player import LiveNodeError, Player, changed_environment, environment
from hmt_ros.app.truth import read_truth
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.filter_parameters import FilterParameters
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from msg_tools import BagReader, BagWriter
from msg_tools.messages.cdr import deserialise
from msg_tools.messages.headers import stamp_in
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, TrackState

RATE, SLOWER = 30.0, 15.0  # images a second
# The slower camera, and its clip.
LARGE = ('--size', '1280x720', '--fps', f'{SLOWER:g}')
SECONDS, QUICK_SECONDS = 16.0, 3.0
MOTION = 'dance'
POSTERIOR, SMOOTHED = 'pose_mixture', 'smoothed_pose_mixture'
# Options of a replay that leaves out the gravity of the bag.
WITHOUT_GRAVITY = ('--set', 'gravity_frame=', '--set', 'fixed_frame=')
START_SECONDS = 120.0  # until the person is tracked: the first images compile the kernels
PATIENCE = 3.0  # s, after the last image
OLDEST = 1.0  # s, of a smoothed pose
# Standard deviation of keypoints, as a share of the height of the person in the image.
NOISE = 0.01
PERSON, TRACKED_INTERVAL = 'person_node', 0.2
PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'


@dataclass(frozen=True)
class Case:
    """How the nodes are run.

    Attributes:
        what: in words.
        transport: of the images.
        room: whether Fast DDS has room for raw images.
        keypoints: whether there are any; then there is no BME.
        together: whether the nodes run in one process.
        smoothed: whether there is a smoother.
        large: whether it is a slower camera of more pixels, see `LARGE`.
        filter, bme: parameters that are not the usual ones.
    """

    what: str
    transport: str = 'raw'
    room: bool = True
    keypoints: bool = False
    together: bool = False
    smoothed: bool = True
    large: bool = False
    filter: Mapping[str, Any] = field(default_factory=dict)
    bme: Mapping[str, Any] = field(default_factory=dict)


CASES = {
    'newest': Case('processes apart: newest complete image'),
    'queue': Case('queue_size 5', filter={'queue_size': 5}, bme={'queue_size': 5}),
    'predictions': Case('predictions from every image', bme={'tracked_interval': 0.0}),
    'compressed': Case('JPEG', transport='compressed'),
    'gravity': Case('gravity given', filter={'gravity': (0.0, 1.0, 0.0)}),
    'keypoints': Case('images and keypoints', keypoints=True),
    'together': Case('one process: newest complete image', together=True),
    'together, filter': Case(
        'one process: filter and experts alone', together=True, smoothed=False
    ),
    'together, keypoints': Case('one process: images and keypoints', keypoints=True, together=True),
    'together, keypoints, filter': Case(
        'one process: the same, filter alone', keypoints=True, together=True, smoothed=False
    ),
    'large': Case('processes apart: 1280x720, 15 images a second', large=True),
    'usual DDS': Case('without fastdds.xml', room=False),
}
OFFLINE = {'offline': 'offline, every image', 'upright': 'offline, gravity given'}
STAGES = (*OFFLINE, *CASES)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('live', __doc__, quick=f'{QUICK_SECONDS:g} seconds each')
    add_choice(parser, STAGES)
    options = parser.parse_args(argv)
    result = measure(QUICK_SECONDS if options.quick else SECONDS, tuple(options.only))
    return show(result, as_text, as_json=options.json)


def measure(seconds: float = SECONDS, only: tuple[str, ...] = STAGES) -> dict[str, Any]:
    """What comes of the images of a camera that does not wait."""
    with tempfile.TemporaryDirectory(prefix='benchmark_live.') as name:
        folder = Path(name)
        clip = folder / 'clip'
        usual = [MOTION, '--duration', f'{seconds:g}', '--quiet', '-o']
        _run(make_bag.main, [*usual, str(clip)])
        if any(stage in only for stage, case in CASES.items() if case.large):
            _run(make_bag.main, [*usual, str(folder / 'large'), *LARGE])
        stages = {
            'offline': lambda: offline(clip, folder / 'offline', *WITHOUT_GRAVITY),
            'upright': lambda: offline(clip, folder / 'upright'),
        }
        for stage, case in CASES.items():
            shown = folder / 'large' if case.large else clip
            stages[stage] = partial(_tried, shown, folder / f'{stage} of nodes', case)
        return run_stages('live', stages, only)


def _run(command: Any, arguments: list[str]) -> None:
    if code := command(arguments):
        raise ValueError(f'{" ".join(arguments)} ended with {code}')


def offline(clip: Path, target: Path, *given: str) -> dict[str, Any]:
    """The clip in lock step: every image, by the parameters of the nodes; its bag tells gravity."""
    options = ['--background', str(clip / 'background.png'), '--quiet', *given]
    start = time.perf_counter()
    _run(replay.main, [str(clip), '-o', str(target), *options])
    truth = read_truth(clip / 'truth.npz')
    return {
        'images': len(truth.joints),
        'seconds': time.perf_counter() - start,
        **_errors(target, truth),
    }


def _errors(bag: Path, truth: Truth) -> dict[str, Any]:
    """Errors of the mixtures in a bag, mm."""
    with BagReader(bag) as opened:
        topics = [x for x in (POSTERIOR, SMOOTHED) if opened.topics[f'/{x}'].message_count]
    found = score_bag(bag, truth, topics=topics)
    return {
        name.strip('/'): {
            what: scores.scores.summary()[what] for what in ('heaviest_mm', 'best_mm')
        }
        for name, scores in found.items()
    }


def _tried(clip: Path, target: Path, case: Case) -> Any:
    environ = {PROFILES: str(PROFILE)} if case.room else {}
    with changed_environment(environ):
        try:
            return live(clip, target, case)
        except LiveNodeError as error:
            return f'skipped: {error}'


def live(clip: Path, target: Path, case: Case) -> dict[str, Any]:
    """The clip through the real nodes, at the rate of the camera.

    Raises:
        LiveNodeError: there is no ROS, or a node does not start or track.
    """
    truth, rate = read_truth(clip / 'truth.npz'), SLOWER if case.large else RATE
    with ExitStack() as opened:
        player = Player(opened)
        nodes = _nodes(player, opened, clip, case)
        for node in nodes:
            node.wait_until_active()
        processes = list({node.process.pid: node for node in nodes}.values())
        arrived = _listen(player)
        told = [str(_detections(clip, truth))] if case.keypoints else []
        camera = _Camera(
            opened, player.domain, clip, case.transport, len(truth.joints), told,
            subscribers=1 if case.keypoints or case.together else 2, rate=rate,
        )  # fmt: skip
        # The kernels are compiled and the track has started before the clip moves.
        camera.spin(player, lambda: len(arrived[POSTERIOR]) > 2, START_SECONDS)
        shift, start_ns = camera.begin(player)
        before = [_cpu_seconds(node) for node in processes]
        at_first = sum(_memory(node) for node in processes)
        received = _received(player)
        camera.spin(player, camera.ended, len(truth.joints) / rate + PATIENCE)
        spent = [_cpu_seconds(node) - past for node, past in zip(processes, before, strict=True)]
        memory = sum(_memory(node) for node in processes)
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            player.executor.spin_once(timeout_sec=0.1)
        received = _received(player) - received
    first = min(truth.joints) + shift
    last = max(truth.joints) + shift
    shown = {
        topic: [(stamp, data, when) for stamp, data, when in messages if first <= stamp <= last]
        for topic, messages in arrived.items()
    }
    with BagWriter(target) as bag:
        for topic, messages in shown.items():
            bag.add_topic(topic, POSE_MIXTURE)
            for stamp, data, _ in messages:
                bag.write_serialised(topic, stamp - shift, _shifted(data, stamp - shift))
    offset = start_ns - first
    latencies = [1e-6 * (when - stamp - offset) for stamp, _, when in shown[POSTERIOR]]
    # The newest image is the one that was due last.
    ages = [1e-9 * min(when - stamp - offset, last - stamp) for stamp, _, when in shown[SMOOTHED]]
    count = len(latencies)
    states = [deserialise(data, POSE_MIXTURE).state for _, data, _ in shown[POSTERIOR]]
    if not count or (case.smoothed and not ages):
        raise LiveNodeError(f'{count} images of the clip were answered, {len(ages)} smoothed')
    return {
        'images': len(truth.joints),
        'lost': max(len(truth.joints) - received, 0),
        'answered': count,
        # Somebody is in view all the time.
        'nobody': states.count(TrackState.NOBODY),
        'track_lost': states.count(TrackState.LOST),
        'camera_late_ms': 1e-6 * camera.latest_ns,
        'latency_ms': {
            what: float(np.percentile(latencies, p)) for what, p in (('median', 50), ('95 %', 95))
        },
        'age_s': {
            what: float(np.percentile(ages, p)) if ages else math.nan
            for what, p in (('median', 50), ('95 %', 95))
        },
        'first_and_last_quarter_ms': [
            float(np.median(part)) for part in (latencies[: count // 4], latencies[-count // 4 :])
        ],
        'memory_mb': memory,
        'grown_mb': memory - at_first,
        'cpu_s': dict(zip((node.name for node in processes), spent, strict=True)),
        'cpu_ms_per_pose': 1e3 * sum(spent) / count,
        'wanted': f'95 % of the smoothed poses at most {OLDEST:g} s old',
        'met': bool(ages) and float(np.percentile(ages, 95)) <= OLDEST,
        **_errors(target, truth),
    }


def _nodes(player: Player, opened: ExitStack, clip: Path, case: Case) -> list[LiveNode]:
    """The nodes as the launch file starts them."""
    images = {
        'image_transport': case.transport,
        'background_file': str(clip / 'background.png'),
    }
    used = {'use_keypoints': True} if case.keypoints else {'use_predictions': True}
    chosen: dict[str, Any] = {
        FILTER: replace(FilterParameters(), **images, **used, **case.filter),
    }
    if case.smoothed:
        chosen[SMOOTHER] = SmootherParameters()
    if not case.keypoints:
        interval = {'tracked_interval': TRACKED_INTERVAL}
        chosen[BME] = replace(BmeParameters(), **{**images, **interval, **case.bme})
    process = None
    if case.together:
        process = NodeProcess(player, opened, PERSON, f'hmt_ros.nodes.{PERSON}', tuple(chosen))
    nodes = [
        LiveNode(
            player, opened, name, parameters, inputs={}, topics={}, within=process, write=_ignored
        )
        for name, parameters in chosen.items()
    ]
    if process is not None:
        process.start()
    return nodes


def _detections(clip: Path, truth: Truth) -> Path:
    """A file of keypoints of each image, as `benchmarks.camera` reads it."""
    info, _ = read_messages(clip, [COMPRESSED], 1)
    camera = np.asarray(info.k).reshape(3, 3)
    joints = np.array([truth.joints[stamp] for stamp in sorted(truth.joints)])
    known = np.isfinite(joints).all((0, 2))
    seen = joints[:, known] @ camera.T
    pixels = seen[..., :2] / seen[..., 2:]
    height = np.ptp(pixels[..., 1], axis=1)[:, None, None]
    pixels += NOISE * height * np.random.default_rng(0).standard_normal(pixels.shape)
    names = np.array(truth.joint_names)[known]
    target = clip / 'keypoints.npz'
    np.savez(target, names=names, pixels=pixels)
    return target


def _listen(player: Player) -> dict[str, list[tuple[int, bytes, int]]]:
    """Lists that fill with stamp, bytes and time of arrival of the mixtures, by topic."""
    arrived: dict[str, list[tuple[int, bytes, int]]] = {POSTERIOR: [], SMOOTHED: []}

    def into(messages: list[tuple[int, bytes, int]], data: bytes) -> None:
        messages.append((stamp_in(data), data, time.monotonic_ns()))

    for topic, messages in arrived.items():

        def heard(data: bytes, messages: Any = messages) -> None:
            into(messages, data)

        player.node.create_subscription(
            player.classes[POSE_MIXTURE], topic, heard, player.reliable, raw=True
        )
    return arrived


class _Camera:
    """The process that shows the clip."""

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
        """Sets the clip in motion; by how much its stamps are later, and when it begins, ns."""
        self._say()
        assert self._process.stdout is not None
        shift, start = self._process.stdout.readline().split()
        return int(shift), int(start)

    def ended(self) -> bool:
        """Whether all images have been published."""
        import select

        assert self._process.stdout is not None
        if not select.select([self._process.stdout], [], [], 0)[0]:
            return False
        self.latest_ns = int(self._process.stdout.readline())
        return True

    def spin(self, player: Player, done: Any, seconds: float) -> None:
        """Listens until something is done.

        Raises:
            LiveNodeError: it takes too long, or the camera has ended.
        """
        end = time.monotonic() + seconds
        while not done():
            player.executor.spin_once(timeout_sec=0.1)
            if self._process.poll() is not None:
                raise LiveNodeError(f'the camera ended with code {self._process.returncode}')
            if time.monotonic() > end:
                raise LiveNodeError(f'no end of the clip, or no track, within {seconds:.0f} s')

    def _say(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(b'\n')
        self._process.stdin.flush()


def _received(player: Player) -> int:
    """Images that have reached the filter, by its diagnostics, which come once a second."""
    return int(player.diagnostics.get(FILTER, {}).get('images received', '0'))


def _cpu_seconds(node: LiveNode) -> float:
    """Time that the process of a node has computed, s."""
    fields = Path(f'/proc/{node.process.pid}/stat').read_text('utf-8').rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def _memory(node: LiveNode) -> float:
    """Memory of the process of a node that no other shares, MB."""
    text = Path(f'/proc/{node.process.pid}/smaps_rollup').read_text('utf-8')
    return sum(int(line.split()[1]) for line in text.splitlines() if line.startswith('Pss:')) / 1e3


def _shifted(data: bytes, stamp_ns: int) -> bytes:
    """A mixture with the stamp of its image in the bag, as it is stored."""
    from benchmarks.publisher import with_stamp
    from msg_tools.messages.cdr import canonical

    return canonical(with_stamp(data, stamp_ns), POSE_MIXTURE)


def _ignored(topic: str, stamp: int, data: bytes) -> None:
    """Results are listened to elsewhere."""


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people."""
    rows = [
        [
            '', 'images', 'lost', 'answered', 'NOBODY', 'latency, median', '95 %', 'CPU per pose',
            'memory', 'smoothed: age, median', '95 %', 'heaviest', 'best of K',
            'smoothed, heaviest',
        ]
    ]  # fmt: skip
    for stage in STAGES:
        found = result.get(stage)
        if found is None:
            continue
        what = OFFLINE.get(stage) or CASES[stage].what
        if isinstance(found, str):
            rows.append([what, found, *[''] * 12])
            continue
        errors = [
            f'{found[POSTERIOR]["heaviest_mm"]:.0f} mm', f'{found[POSTERIOR]["best_mm"]:.0f} mm',
            f'{found[SMOOTHED]["heaviest_mm"]:.0f} mm' if SMOOTHED in found else '',
        ]  # fmt: skip
        if stage in OFFLINE:
            rows.append([what, str(found['images']), '0', '100 %', *[''] * 7, *errors])
            continue
        latency, age = found['latency_ms'], found['age_s']
        rows.append(
            [
                what, str(found['images']), str(found['lost']),
                f'{100 * found["answered"] / found["images"]:.0f} %', str(found['nobody']),
                f'{latency["median"]:.0f} ms', f'{latency["95 %"]:.0f} ms',
                f'{found["cpu_ms_per_pose"]:.0f} ms', f'{found["memory_mb"]:.0f} MB',
                *('' if math.isnan(age[x]) else f'{age[x]:.2f} s' for x in ('median', '95 %')),
                *errors,
            ]
        )  # fmt: skip
    return table(rows, markdown=markdown)
