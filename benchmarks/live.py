"""live: the nodes with a camera that does not wait for them.

A clip with known truth is rendered (`benchmarks.live_clips`). A camera process publishes it to the
real nodes at its frame rate, on the same machine; a third process listens. Keypoints are the true
joints with detector noise, published after each image, or those of MediaPipe, which then competes
with the nodes for the processor. Latency is the time from when an image is due at the camera to the
arrival of its pose_mixture; age is the time from the image of a smoothed pose to the newest image
when the pose arrives. The clip of the dancer is also replayed offline, using every image. Separate
runs sample the distribution of CPU time in replay and live.

In a visit a person enters and leaves an empty scene: `keep_out` must not report NOBODY for an image
with half of the joints or more, and must report it from one second after the last joint has left.
With several people the topic `people` is scored. --runs repeats each case and shows medians;
--minutes plays the clip back and forth for this time.
"""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.camera import with_stamp
from benchmarks.clips import COMPRESSED, index_back_and_forth, read_messages, table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.live_clips import (
    MOTION,
    PEOPLE,
    VISIT,
    make_clip,
    noisy_keypoints,
    rate_of,
    run,
    shares_in_view,
)
from benchmarks.live_nodes import (
    CASES,
    CameraProcess,
    Case,
    cpu_seconds,
    memory,
    start_nodes,
)
from benchmarks.nodes import PROFILE
from benchmarks.sampling import (
    PROFILE_FILE,
    StackSampler,
    profile_of,
    profiles_as_text,
    read_samples,
)
from hmt_ros.app.evaluate import score_bag
from hmt_ros.app.replay import command as replay
from hmt_ros.app.replay.live_node import LiveNode
from hmt_ros.app.replay.player import LiveNodeError, Player
from hmt_ros.app.truth import read_truth
from hmt_ros.detectors.blazepose import BlazePose
from hmt_ros.detectors.detector import DetectorError
from hmt_ros.evaluation.track_scores import Truth
from hmt_ros.sessions.image_inputs import DETECTIONS, KEYPOINTS
from msg_tools import BagReader, BagWriter
from msg_tools.messages.cdr import canonical, deserialise
from msg_tools.messages.detections import PEOPLE_2D
from msg_tools.messages.headers import stamp_in, time_ns
from msg_tools.messages.keep_out import KEEP_OUT, KeepOutState
from msg_tools.messages.pose_mixtures import POSE_MIXTURE, TrackState

SECONDS, QUICK_SECONDS, QUICK = 16.0, 1.5, ('together',)
POSTERIOR, SMOOTHED = 'pose_mixture', 'smoothed_pose_mixture'
TOLD, LISTED = 'keep_out', 'people'
# Options of a replay that leaves out the gravity of the bag.
WITHOUT_GRAVITY = ('--set', 'gravity_frame=', '--set', 'fixed_frame=')
# Options that add the experts, as in `person_node`.
WITH_EXPERTS = ('--bme', '--set', 'bme.tracked_interval=0.2')
START_SECONDS = 120.0  # maximum time until the person is tracked, s
PATIENCE = 3.0  # wait after the last image, s
# Maximum delay of a state in a visit, s, and minimum share of visible joints of a person.
LATE, SOMEBODY = 1.0, 0.5
PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'


OFFLINE = {'offline': 'offline, every image', 'upright': 'offline, gravity given'}
REPLAY = 'sampled replay'
STAGES = (*OFFLINE, REPLAY, *CASES)


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('live', __doc__, quick=f'{QUICK_SECONDS:g} seconds of {QUICK[0]}')
    add_choice(parser, STAGES)
    parser.add_argument('--runs', type=int, default=1, help='runs of each case (1)')
    parser.add_argument('--minutes', type=float, help='of each case (as long as the clip)')
    options = parser.parse_args(argv)
    seconds = QUICK_SECONDS if options.quick else SECONDS
    only = QUICK if options.quick and options.only is STAGES else tuple(options.only)
    result = measure(seconds, only, options.runs, options.minutes)
    return show(result, as_text, as_json=options.json)


def measure(
    seconds: float = SECONDS,
    only: Sequence[str] = STAGES,
    runs: int = 1,
    minutes: float | None = None,
) -> dict[str, Any]:
    """Runs the cases with a camera that does not wait."""
    with tempfile.TemporaryDirectory(prefix='benchmark_live.') as name:
        folder = Path(name)

        def dance() -> Path:
            return make_clip(folder, MOTION, seconds)

        stages = {
            'offline': lambda: offline(dance(), folder / 'offline', *WITHOUT_GRAVITY),
            'upright': lambda: offline(dance(), folder / 'upright'),
            REPLAY: lambda: sampled_replay(dance(), folder / REPLAY),
        }
        for stage, case in CASES.items():
            stages[stage] = partial(_tried, folder, stage, case, seconds, runs, minutes)
        return run_stages('live', stages, only)


def offline(clip: Path, target: Path, *given: str) -> dict[str, Any]:
    """Replays every image of the clip with the parameters of the nodes; the bag has gravity."""
    start = time.perf_counter()
    _replay(clip, target, *given)
    truth = read_truth(clip / 'truth.npz')
    return {
        'images': len(truth.joints),
        'seconds': time.perf_counter() - start,
        **_errors(target, truth),
    }


def _replay(clip: Path, target: Path, *given: str) -> None:
    options = ['--background', str(clip / 'background.png'), '--quiet', *given]
    run(replay.main, [str(clip), '-o', str(target), *options])


def sampled_replay(clip: Path, target: Path) -> dict[str, Any]:
    """Profile of a replay with filter, smoother and experts."""
    with StackSampler() as sampler:
        _replay(clip, target, *WITHOUT_GRAVITY, *WITH_EXPERTS)
    return {'profile': profile_of(sampler.samples(), len(_stamps(clip)))}


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


def _tried(
    folder: Path, stage: str, case: Case, seconds: float, runs: int, minutes: float | None
) -> Any:
    clip = make_clip(folder, case.clip, seconds)
    try:
        if case.detector:
            BlazePose()
        with patch.dict(os.environ, {PROFILES: str(PROFILE)}):
            if case.sampled:
                return sampled(clip, folder / stage, case, minutes)
            found = [live(clip, folder / f'{stage} {k}', case, minutes) for k in range(runs)]
    except (LiveNodeError, DetectorError) as error:
        return f'skipped: {error}'
    return median_of(found)


def sampled(clip: Path, target: Path, case: Case, minutes: float | None) -> dict[str, Any]:
    """Profile of the nodes while the clip moves, per answered image."""
    file = target.with_suffix('.json')
    with patch.dict(os.environ, {PROFILE_FILE: str(file)}):
        found = live(clip, target, case, minutes)
    first, last = (round(x) for x in found['clock_s'])
    samples = [sample for sample in read_samples(file) if first <= sample.second < last]
    cpu = sum(found['cpu_s'].values())
    return {'profile': profile_of(samples, found['answered'], cpu)}


def median_of(found: Sequence[Any]) -> Any:
    """Medians of the numbers of several runs, in the same nested structure."""
    first = found[0]
    if isinstance(first, dict):
        return {key: median_of([each[key] for each in found if key in each]) for key in first}
    if isinstance(first, list):
        return [median_of(each) for each in zip(*found, strict=True)]
    if isinstance(first, bool) or not isinstance(first, int | float):
        return first
    return type(first)(np.median(found))


def live(clip: Path, target: Path, case: Case, minutes: float | None = None) -> dict[str, Any]:
    """Plays the clip to the real nodes at the camera's rate, once or back and forth.

    Raises:
        LiveNodeError: ROS is missing, or a node does not start or track.
    """
    rate, own = rate_of(case.clip), _stamps(clip)
    planned = len(own) if minutes is None else round(60 * minutes * rate)
    indices = [index_back_and_forth(number, len(own)) for number in range(planned)]
    step = round(1e9 / rate)
    # Timestamps of published images, as in `benchmarks.camera`, and of their images in the clip.
    shows = {
        own[0] + (own[i] - own[0] if i == k else k * step): own[i] for k, i in enumerate(indices)
    }
    stamps = sorted(shows)
    memories: list[float] = []
    with ExitStack() as opened:
        player = Player(opened)
        nodes = start_nodes(player, opened, clip, case)
        for node in nodes:
            node.wait_until_active()
        processes = list({node.process.pid: node for node in nodes}.values())
        arrived = _listen(player, case)
        more = []
        if case.people:
            more = [str(clip), DETECTIONS]
        elif case.keypoints and not case.detector:
            more = [str(noisy_keypoints(clip)), KEYPOINTS]
        camera = CameraProcess(
            opened, player.domain, clip, case.transport, len(stamps), more,
            subscribers=1 if case.keypoints or case.together else 2, rate=rate,
        )  # fmt: skip
        # Wait until the track has started before the clip moves.
        topic = _topic_of(case)
        camera.spin(player, lambda: len(arrived[topic]) > 2, START_SECONDS)
        shift, start_ns = camera.begin(player)
        before, began = [cpu_seconds(node) for node in processes], time.monotonic()
        received = _received(player, nodes[0])
        camera.spin(
            player, camera.ended, len(stamps) / rate + PATIENCE,
            every=lambda: memories.append(sum(memory(node, 'Pss_Anon') for node in processes)),
        )  # fmt: skip
        spent = [cpu_seconds(node) - past for node, past in zip(processes, before, strict=True)]
        clock = began, time.monotonic()
        memory_mb = sum(memory(node) for node in processes)
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            player.executor.spin_once(timeout_sec=0.1)
        received = _received(player, nodes[0]) - received
    first, last = stamps[0] + shift, stamps[-1] + shift
    shown = {
        topic: [(stamp, data, when) for stamp, data, when in messages if first <= stamp <= last]
        for topic, messages in arrived.items()
    }
    offset = start_ns - first
    latencies = [1e-6 * (when - stamp - offset) for stamp, _, when in shown[topic]]
    # The newest image is the one that was due last.
    ages = [1e-9 * min(when - stamp - offset, last - stamp) for stamp, _, when in shown[SMOOTHED]]
    count = len(latencies)
    if not count or (case.smoothed and not case.people and not ages):
        raise LiveNodeError(f'{count} images of the clip were answered, {len(ages)} smoothed')
    result = {
        'images': len(stamps),
        'lost': max(len(stamps) - received, 0),
        'answered': count,
        'clock_s': clock,
        'camera_late_ms': 1e-6 * camera.latest_ns,
        'latency_ms': {
            what: float(np.percentile(latencies, p))
            for what, p in (('median', 50), ('95 %', 95), ('99 %', 99))
        },
        'age_s': {
            what: float(np.percentile(ages, p)) if ages else math.nan
            for what, p in (('median', 50), ('95 %', 95))
        },
        'first_and_last_quarter_ms': [
            float(np.median(part)) for part in (latencies[: count // 4], latencies[-count // 4 :])
        ],
        'memory_mb': memory_mb,
        # In total, and in the second half, when everything has happened at least once.
        'grown_mb': memories[-1] - memories[0] if memories else 0.0,
        'grown_later_mb': memories[-1] - memories[len(memories) // 2] if memories else 0.0,
        'cpu_s': dict(zip((node.name for node in processes), spent, strict=True)),
        'cpu_ms_per_pose': 1e3 * sum(spent) / count,
    }
    by_stamp = {
        topic: {stamp - shift: data for stamp, data, _ in messages}
        for topic, messages in shown.items()
    }
    if case.people:
        return result | _listed(by_stamp[LISTED])
    if case.clip == VISIT:
        return result | told_of_a_visit(by_stamp[TOLD], clip, rate)
    with BagWriter(target) as bag:
        for topic in (POSTERIOR, SMOOTHED):
            bag.add_topic(topic, POSE_MIXTURE)
            for stamp, data in by_stamp[topic].items():
                bag.write_serialised(topic, stamp, _shifted(data, stamp))
    states = [deserialise(data, POSE_MIXTURE).state for data in by_stamp[POSTERIOR].values()]
    # Somebody is in view all the time.
    truth = read_truth(clip / 'truth.npz')
    truth = replace(
        truth, joints={stamp: truth.joints[own] for stamp, own in shows.items()}, ground={}
    )
    return result | {
        'nobody': states.count(TrackState.NOBODY),
        'track_lost': states.count(TrackState.LOST),
        **_errors(target, truth),
    }


def _topic_of(case: Case) -> str:
    """The topic that answers an image."""
    if case.people:
        return LISTED
    return TOLD if case.clip == VISIT else POSTERIOR


def _stamps(clip: Path) -> list[int]:
    _, images = read_messages(clip, [COMPRESSED])
    return [time_ns(image.header.stamp) for image in images]


def _listed(messages: Mapping[int, bytes]) -> dict[str, Any]:
    """Mean number of people in the answers."""
    counts = [len(deserialise(data, PEOPLE_2D).ids) for data in messages.values()]
    return {'people': float(np.mean(counts))}


def told_of_a_visit(messages: Mapping[int, bytes], clip: Path, rate: float) -> dict[str, Any]:
    """Compares the reported states of a visit with its images."""
    shares = shares_in_view(clip)
    stamps = sorted(shares)
    late = round(LATE * rate)
    states = {
        stamp: KeepOutState(int(deserialise(data, KEEP_OUT).state))
        for stamp, data in messages.items()
    }
    # Shares in view during the time by which an answer is allowed to be late.
    lasting = {
        stamp: [shares[each] for each in stamps[max(k - late, 0) : k + 1]]
        for k, stamp in enumerate(stamps)
    }
    whole = [states[x] for x in states if min(lasting[x]) == 1.0]
    # The state is UNKNOWN until a person has entered.
    came = min(stamp for stamp in stamps if shares[stamp] > 0.0)
    away = [states[x] for x in states if x > came and max(lasting[x]) == 0.0]
    return {
        'nobody': sum(
            state is KeepOutState.NOBODY and shares[stamp] >= SOMEBODY
            for stamp, state in states.items()
        ),
        'in_view': len(whole),
        'in_view_tracked': whole.count(KeepOutState.TRACKING),
        'away': len(away),
        'away_not_nobody': len(away) - away.count(KeepOutState.NOBODY),
    }


def _listen(player: Player, case: Case) -> dict[str, list[tuple[int, bytes, int]]]:
    """Subscribes; the lists, by topic, collect timestamp, bytes and arrival time of messages."""
    from hmt_msgs.msg import KeepOut, People2D, PoseMixture

    kinds = {POSTERIOR: PoseMixture, SMOOTHED: PoseMixture, TOLD: KeepOut, LISTED: People2D}
    arrived: dict[str, list[tuple[int, bytes, int]]] = {topic: [] for topic in kinds}

    def into(messages: list[tuple[int, bytes, int]], data: bytes) -> None:
        messages.append((stamp_in(data), data, time.monotonic_ns()))

    for topic, messages in arrived.items():
        # A node does not produce a topic without subscribers.
        if topic == TOLD and not case.keep_out:
            continue

        def heard(data: bytes, messages: Any = messages) -> None:
            into(messages, data)

        player.node.create_subscription(kinds[topic], topic, heard, player.reliable, raw=True)
    return arrived


def _received(player: Player, node: LiveNode) -> int:
    """Number of images received by a node, from its diagnostics, published once a second."""
    return int(player.diagnostics.get(node.name, {}).get('images received', '0'))


def _shifted(data: bytes, stamp_ns: int) -> bytes:
    """Serialised mixture with the timestamp of its image in the bag."""
    return canonical(with_stamp(data, stamp_ns), POSE_MIXTURE)


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable tables: one person in view, a visit, several people."""
    found = {stage: result[stage] for stage in STAGES if stage in result}
    profiles = {
        'replay' if stage == REPLAY else CASES[stage].what: found.pop(stage)['profile']
        for stage in list(found)
        if 'profile' in found[stage]
    }
    visits = {stage: found.pop(stage) for stage in list(found) if _clip_of(stage) == VISIT}
    crowds = {
        stage: found.pop(stage) for stage in list(found) if _clip_of(stage).startswith(PEOPLE)
    }
    tables = []
    if found:
        tables.append(_table_of_one(found, markdown=markdown))
    if visits:
        columns = {
            'false NOBODY': lambda x: str(x['nobody']),
            'TRACKING, whole in view': lambda x: f'{x["in_view_tracked"]} of {x["in_view"]}',
            'not NOBODY, left': lambda x: f'{x["away_not_nobody"]} of {x["away"]}',
        }
        tables.append(_short_table('a visit', visits, columns, markdown=markdown))
    if crowds:
        columns = {'people told of': lambda x: f'{x["people"]:.2f}'}
        tables.append(_short_table('people', crowds, columns, markdown=markdown))
    if profiles:
        tables.append(profiles_as_text(profiles, markdown=markdown))
    return '\n\n'.join(tables)


def _clip_of(stage: str) -> str:
    return CASES[stage].clip if stage in CASES else MOTION


def _timing(found: dict[str, Any]) -> list[str]:
    latency = found['latency_ms']
    return [
        str(found['images']), str(found['lost']),
        f'{100 * found["answered"] / found["images"]:.0f} %',
        *(f'{latency[x]:.0f} ms' for x in ('median', '95 %', '99 %')),
        f'{found["cpu_ms_per_pose"]:.0f} ms', f'{found["memory_mb"]:.0f} MB',
    ]  # fmt: skip


TIMING = ['images', 'lost', 'answered', 'latency, median', '95 %', '99 %', 'CPU per pose', 'memory']


def _short_table(
    what: str,
    found: Mapping[str, Any],
    columns: Mapping[str, Callable[[dict[str, Any]], str]],
    *,
    markdown: bool,
) -> str:
    rows = [[what, *TIMING, *columns]]
    for stage, one in found.items():
        if isinstance(one, str):
            rows.append([CASES[stage].what, one, *[''] * (len(rows[0]) - 2)])
        else:
            rows.append([CASES[stage].what, *_timing(one), *(x(one) for x in columns.values())])
    return table(rows, markdown=markdown)


def _table_of_one(found: Mapping[str, Any], *, markdown: bool) -> str:
    rows = [
        [
            '', *TIMING, 'NOBODY', 'smoothed: age, median', '95 %', 'heaviest', 'best of K',
            'smoothed, heaviest',
        ]
    ]  # fmt: skip
    for stage, one in found.items():
        what = OFFLINE.get(stage) or CASES[stage].what
        if isinstance(one, str):
            rows.append([what, one, *[''] * (len(rows[0]) - 2)])
            continue
        errors = [
            f'{one[POSTERIOR]["heaviest_mm"]:.0f} mm', f'{one[POSTERIOR]["best_mm"]:.0f} mm',
            f'{one[SMOOTHED]["heaviest_mm"]:.0f} mm' if SMOOTHED in one else '',
        ]  # fmt: skip
        if stage in OFFLINE:
            rows.append([what, str(one['images']), '0', '100 %', *[''] * 8, *errors])
            continue
        age = one['age_s']
        ages = ('' if math.isnan(age[x]) else f'{age[x]:.2f} s' for x in ('median', '95 %'))
        rows.append([what, *_timing(one), str(one['nobody']), *ages, *errors])
    return table(rows, markdown=markdown)
