"""nodes: what ROS adds to an image, and whether nodes keep up with cameras, through DDS."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import hmt_ros
from benchmarks.clips import COMPRESSED, find_clips, index_back_and_forth, read_messages, table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from benchmarks.publisher import with_stamp
from hmt_ros.app.replay.live_node import LiveNode
from hmt_ros.app.replay.player import LiveNodeError, Player, changed_environment
from hmt_ros.sessions import bme_session, track_messages
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from hmt_ros.sessions.session import PublishedTopic
from hmt_ros.sessions.tracking_parameters import FilterParameters
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import compressed_image_message, decode_image, image_message

RATE = 30.0  # images a second
SECONDS = 20.0
WARM_UP = 10  # images before it counts: kernels are compiled
PATIENCE = 2.0  # s after the last image
KEPT = 0.99  # share of the images whose results came
SIZE = (640, 480)
MEDIAN_MS, LATE_MS = 5.0, 15.0  # wanted of what ROS adds, median and 99th percentile
HELD = 0.8  # of the rate that the filter reaches
# Images that may wait, where every image is to be used: no node is late, but images come in bursts.
QUEUE = 5
PEOPLE = (1, 2, 4)
# Room in shared memory for raw images.
PROFILE = Path(hmt_ros.__file__).parent / 'config' / 'fastdds.xml'

STAGES = ('added, raw', 'added, compressed', 'filter_node', *map(str, PEOPLE))


@dataclass(frozen=True, eq=False)
class Feed:
    """A node and what it gets.

    Attributes:
        node: its name.
        module: that runs it; empty: the usual one.
        parameters: of the node.
        topics: that it publishes.
        result: the one whose messages carry the stamp of an image.
        info: calibration.
        images: that are shown forwards and backwards.
        start_ns: stamp of the first.
        step_ns: between two.
    """

    node: str
    module: str
    parameters: Any
    topics: Mapping[str, PublishedTopic]
    result: str
    info: Any
    images: Sequence[Any]
    start_ns: int
    step_ns: int

    def inputs(self) -> dict[str, tuple[str, str]]:
        """Topic and type by source."""
        raw = self.parameters.image_transport == 'raw'
        image = ('image', 'Image') if raw else ('image/compressed', 'CompressedImage')
        return {
            CAMERA_INFO: ('camera_info', 'sensor_msgs/msg/CameraInfo'),
            IMAGE: (image[0], f'sensor_msgs/msg/{image[1]}'),
        }


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('nodes', __doc__, quick='two seconds each')
    add_choice(parser, STAGES)
    parser.add_argument('--model', default='', help='of bme_node; usual: the one that ships')
    options = parser.parse_args(argv)
    result = measure(2.0 if options.quick else SECONDS, options.model, tuple(options.only))
    return show(result, as_text, as_json=options.json)


def measure(
    seconds: float = SECONDS, model: str = '', only: tuple[str, ...] = STAGES
) -> dict[str, Any]:
    """What comes of images at the rate of a camera."""
    stages: dict[str, Callable[[], Any]] = {
        'added, raw': lambda: _added('raw', seconds),
        'added, compressed': lambda: _added('compressed', seconds),
        'filter_node': lambda: _held(_filter(), seconds),
        **{str(count): lambda n=count: _of_people(_bme(model), n, seconds) for count in PEOPLE},
    }

    def tried(stage: Callable[[], Any]) -> Any:
        try:
            return stage()
        except LiveNodeError as error:
            return f'skipped: {error}'

    chosen = {name: (lambda stage=stage: tried(stage)) for name, stage in stages.items()}
    with changed_environment({'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILE)}):
        return run_stages('nodes', chosen, only)


def _added(transport: str, seconds: float) -> dict[str, Any]:
    (found,) = followed(prompt_feed(transport), seconds, RATE)
    times = found['latency_ms']
    wanted = f'{MEDIAN_MS:g} ms median, {LATE_MS:g} ms at 99 %, none lost'
    return {
        **found,
        'wanted': wanted,
        'met': found['results'] == found['images']
        and times['median'] <= MEDIAN_MS
        and times['99 %'] <= LATE_MS,
    }


def _of_people(feed: Feed, count: int, seconds: float) -> dict[str, Any]:
    """Nodes for so many people in namespaces of their own; each has its own images."""
    names = tuple(f'/humans/bodies/p{i}' for i in range(count)) if count > 1 else ('',)
    people = followed(feed, seconds, RATE, names)
    worst = max(people, key=lambda found: found['latency_ms']['99 %'] or np.inf)
    results, images = (sum(found[what] for found in people) for what in ('results', 'images'))
    return {
        **worst,
        'images': images,
        'results': results,
        'people': people,
        'wanted': f'at least {100 * KEPT:g} % of the images',
        'met': all(found['results'] >= KEPT * found['images'] for found in people),
    }


def _held(feed: Feed, seconds: float) -> dict[str, Any]:
    """The filter at a rate that it can hold: it must use every image."""
    (reached,) = followed(feed, seconds, None)
    rate = HELD * reached['answered_hz']
    (found,) = followed(feed, seconds, rate)
    return {
        **found,
        'reached_hz': reached['answered_hz'],
        'wanted': f'all images at {HELD:.0%} of its rate, {reached["answered_hz"]:.1f} Hz',
        'met': found['results'] == found['images'],
    }


def followed(
    feed: Feed, seconds: float, rate: float | None, namespaces: Sequence[str] = ('',)
) -> list[dict[str, Any]]:
    """Publishes images to nodes, forwards and backwards, and listens to results.

    Args:
        feed: the node, and what it gets.
        seconds: that are measured.
        rate: images a second; None: one when the one before is answered.
        namespaces: of the nodes, one each.

    Returns:
        Of each node what came.
    """
    with ExitStack() as opened:
        player = Player(opened)
        nodes = [_Heard(feed, player, opened, namespace) for namespace in namespaces]
        for one in nodes:
            one.connect()
        data = [serialise(image) for image in feed.images]
        # What is compiled in the first images is not to be waited for by the others.
        for number in range(WARM_UP):
            for one in nodes:
                one.show(number, data)
            for one in nodes:
                one.wait(player)
        warm = len(nodes[0].sent)
        first, number = time.perf_counter(), 0
        while time.perf_counter() < first + seconds:
            for i, one in enumerate(nodes):
                if rate is not None:
                    # Cameras are not synchronised.
                    due = first + (number + i / len(nodes)) / rate
                    while (left := due - time.perf_counter()) > 0:
                        player.executor.spin_once(timeout_sec=left)
                one.show(warm + number, data)
                if rate is None:
                    one.wait(player)
            number += 1
        spent = time.perf_counter() - first
        late = spent - number / rate if rate is not None else 0.0
        end = time.perf_counter() + PATIENCE
        while time.perf_counter() < end and not all(one.complete() for one in nodes):
            player.executor.spin_once(timeout_sec=0.05)
        for one in nodes:
            one.node.stop_well()
    return [one.told(warm, rate, number / spent, late) for one in nodes]


class _Heard:
    """A node, what it was shown, and when results came."""

    def __init__(self, feed: Feed, player: Player, opened: ExitStack, namespace: str) -> None:
        self.feed, self.namespace = feed, namespace
        self.sent: dict[int, float] = {}
        self.arrived: dict[int, float] = {}
        topics = {feed.result: feed.topics[feed.result]}
        self.node = LiveNode(
            player,
            opened,
            feed.node,
            feed.parameters,
            inputs=feed.inputs(),
            topics={},
            namespace=namespace,
            module=feed.module,
            write=_ignored,
        )
        kind = player.classes[topics[feed.result].msgtype]

        def heard(data: bytes) -> None:
            # The stamp opens the message; to read the rest takes longer than to receive it.
            now = time.perf_counter()
            seconds, nanoseconds = np.frombuffer(data, '<i4', 2, 4).tolist()
            self.arrived[seconds * 10**9 + nanoseconds] = now

        topic = f'{namespace}/{feed.result}'
        player.node.create_subscription(kind, topic, heard, player.reliable, raw=True)

    def connect(self) -> None:
        """Returns when it listens, and is listened to."""
        self.node.wait_until_active()
        self.node.wait_for_subscribers((self.feed.result,), 1)
        self.node.publish(CAMERA_INFO, self.feed.info)

    def show(self, number: int, data: Sequence[bytes]) -> None:
        """Publishes an image."""
        stamp = self.feed.start_ns + number * self.feed.step_ns
        content = with_stamp(data[index_back_and_forth(number, len(data))], stamp)
        self.sent[stamp] = time.perf_counter()
        self.node.publish_bytes(IMAGE, content)

    def wait(self, player: Player) -> None:
        """Returns when the last image is answered, or lost."""
        stamp = next(reversed(self.sent))
        end = time.perf_counter() + (PATIENCE if self.arrived else 15 * PATIENCE)
        while stamp not in self.arrived and time.perf_counter() < end:
            player.executor.spin_once(timeout_sec=0.05)

    def complete(self) -> bool:
        """Whether all has come."""
        return len(self.arrived) >= len(self.sent)

    def told(self, warm: int, rate: float | None, reached: float, late: float) -> dict[str, Any]:
        """What came after the first images."""
        counted = sorted(self.sent)[warm:]
        delays = 1e3 * np.array(
            [self.arrived[x] - self.sent[x] for x in counted if x in self.arrived]
        )
        return {
            'namespace': self.namespace,
            'rate_hz': rate if rate is not None else reached,
            'answered_hz': reached * len(delays) / max(len(counted), 1),
            'images': len(counted),
            'results': len(delays),
            'last_image_late_ms': 1e3 * late,
            'latency_ms': {
                what: float(np.percentile(delays, p)) if len(delays) else None
                for what, p in (('median', 50), ('99 %', 99), ('largest', 100))
            },
        }


@cache
def _recorded() -> tuple[Path, Any, list[Any]]:
    """A clip: its folder, calibration and images."""
    folder = find_clips(None)[0][-1]
    return folder, *read_messages(folder, [COMPRESSED])


def prompt_feed(transport: str) -> Feed:
    """A node whose estimate costs nothing, and images of the usual size."""
    messages = RosbagsMessages()
    _, info, recorded = _recorded()
    images = []
    for message in recorded[:30]:
        picture = np.asarray(cv2.resize(decode_image(message), SIZE), np.uint8)
        made = image_message if transport == 'raw' else compressed_image_message
        images.append(made(messages, picture, time_ns(message.header.stamp), 'lens'))
    return Feed(
        'bme_node',
        'benchmarks.prompt_node',
        BmeParameters(image_transport=transport, queue_size=QUEUE),
        bme_session.TOPICS,
        bme_session.PREDICTION,
        replace(info, width=SIZE[0], height=SIZE[1]),
        images,
        10**18,
        round(1e9 / RATE),
    )


def _bme(model: str) -> Feed:
    folder, info, images = _recorded()
    return Feed(
        'bme_node',
        '',
        BmeParameters(
            image_transport='compressed',
            background_file=str(folder / 'background.png'),
            model_file=model,
        ),
        bme_session.TOPICS,
        bme_session.PREDICTION,
        info,
        images,
        10**18,
        round(1e9 / RATE),
    )


def _filter() -> Feed:
    folder, info, images = _recorded()
    stamps = [time_ns(image.header.stamp) for image in images[:2]]
    return Feed(
        'filter_node',
        '',
        FilterParameters(
            image_transport='compressed',
            background_file=str(folder / 'background.png'),
            subject_file=str(folder / 'subject.yaml'),
            queue_size=QUEUE,
        ),
        track_messages.TOPICS,
        'pose_mixture',
        info,
        images,
        stamps[0],
        stamps[1] - stamps[0],
    )


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people."""
    rows = [
        ['', 'images a second', 'answered', 'images', 'results', 'median', '99 %', 'largest', '']
    ]
    for name in STAGES:
        found = result.get(name)
        if found is None:
            continue
        if isinstance(found, str):
            rows.append([_ROWS[name], found, '', '', '', '', '', '', ''])
            continue
        times = found['latency_ms'].values()
        rows.append(
            [
                _ROWS[name], f'{found["rate_hz"]:.3g}',
                f'{found["answered_hz"]:.3g}', str(found['images']),
                str(found['results']), *('' if x is None else f'{x:.1f} ms' for x in times),
                ('met: ' if found['met'] else 'missed, wanted ') + found['wanted'],
            ]
        )  # fmt: skip
    return table(rows, markdown=markdown)


_ROWS = {
    'added, raw': 'ROS alone, 640x480 bgr8',
    'added, compressed': 'ROS alone, 640x480 JPEG',
    'filter_node': 'filter_node',
    '1': 'bme_node of 1 person',
    '2': 'bme_nodes of 2 people',
    '4': 'bme_nodes of 4 people',
}


def _ignored(topic: str, stamp: int, data: bytes) -> None:
    """Results are listened to elsewhere."""
