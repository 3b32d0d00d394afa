"""nodes: whether a node keeps up with a camera, through DDS, and how late its results are."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.clips import find_clips, table
from benchmarks.command import benchmark_parser, run_stages, show
from benchmarks.machine import on_machine
from hmt_ros.app.live_node import LiveNode, LiveNodeError, Player
from hmt_ros.nodes import bme_session
from hmt_ros.nodes.bme_parameters import BmeParameters
from hmt_ros.nodes.published_topic import PublishedTopic
from msg_tools import BagReader
from msg_tools.headers import time_ns

RATE = 30.0  # images a second
SECONDS = 20.0
WARM_UP = 60  # images before it counts: kernels are compiled, the background is learned
PATIENCE = 2.0  # s after the last image
KEPT = 0.99  # share of the images whose results came


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('nodes', __doc__, quick='two seconds')
    parser.add_argument('--model', default='', help='of bme_node; usual: the one that ships')
    options = parser.parse_args(argv)
    result = measure(2.0 if options.quick else SECONDS, options.model)
    return show(result, as_text, as_json=options.json)


def page() -> str:
    """The part of the documentation that this benchmark writes."""
    result = measure()
    return f'{as_text(result, markdown=True)}\n\n{on_machine(result["machine"])}'


def measure(seconds: float = SECONDS, model: str = '') -> dict[str, Any]:
    """What comes of images at the rate of a camera."""
    folder = find_clips(None)[0][-1]
    parameters = replace(
        BmeParameters(),
        image_transport='compressed',
        background_file=str(folder / 'background.png'),
        model_file=model,
    )

    def predicted() -> dict[str, Any] | str:
        try:
            return followed(
                'bme_node', parameters, bme_session.TOPICS, bme_session.PREDICTION, folder, seconds
            )
        except LiveNodeError as error:
            return f'skipped: {error}'

    return run_stages('nodes', {'bme_node': predicted}, ('bme_node',))


def followed(
    name: str,
    parameters: Any,
    topics: Mapping[str, PublishedTopic],
    result_topic: str,
    folder: Path,
    seconds: float,
) -> dict[str, Any]:
    """Publishes images of a bag at `RATE`, forwards and backwards, and listens to results.

    Args:
        name: of the node.
        parameters: of the node.
        topics: that it publishes.
        result_topic: the one whose messages carry the stamp of an image.
        folder: of the bag.
        seconds: that are measured.
    """
    info, images = recorded(folder)
    sent: dict[int, float] = {}
    arrived: dict[int, float] = {}
    with ExitStack() as opened:
        player = Player(opened)
        inputs = {
            'camera_info': ('camera_info', 'sensor_msgs/msg/CameraInfo'),
            'image': ('image/compressed', 'sensor_msgs/msg/CompressedImage'),
        }
        node = LiveNode(
            player, opened, name, parameters, inputs=inputs, topics=topics, write=_ignored
        )
        kind = player.classes[topics[result_topic].msgtype]

        def heard(message: Any) -> None:
            arrived[time_ns(message.header.stamp)] = time.perf_counter()

        player.node.create_subscription(kind, result_topic, heard, player.reliable)
        node.wait_until_active()
        node.wait_for_subscribers((result_topic,), 2)
        node.publish('camera_info', info)
        first = time.perf_counter()
        count = WARM_UP + round(seconds * RATE)
        for i, image in zip(range(count), back_and_forth(images), strict=False):
            while (left := first + i / RATE - time.perf_counter()) > 0:
                player.executor.spin_once(timeout_sec=left)
            stamp = round(1e9 * (1.0 + i / RATE))
            image.header.stamp.sec, image.header.stamp.nanosec = divmod(stamp, 10**9)
            sent[stamp] = time.perf_counter()
            node.publish('image', image)
        end = time.perf_counter() + PATIENCE
        while time.perf_counter() < end and len(arrived) < count:
            player.executor.spin_once(timeout_sec=0.05)
        late = max(sent.values()) - first - (count - 1) / RATE
        node.stop_well()
    counted = sorted(sent)[WARM_UP:]
    delays = 1e3 * np.array([arrived[x] - sent[x] for x in counted if x in arrived])
    share = len(delays) / len(counted)
    return {
        'clip': folder.name,
        'rate_hz': RATE,
        'images': len(counted),
        'results': len(delays),
        'last_image_late_ms': 1e3 * late,
        'latency_ms': {
            what: float(np.percentile(delays, p)) if len(delays) else None
            for what, p in (('median', 50), ('99 %', 99), ('largest', 100))
        },
        'wanted': f'at least {100 * KEPT:g} % of the images',
        'met': share >= KEPT,
    }


def recorded(folder: Path) -> tuple[Any, list[Any]]:
    """The calibration and the images of a bag."""
    with BagReader(folder) as bag:
        info = next(bag.messages([bag.find_topic(['sensor_msgs/msg/CameraInfo']).name])).message
        topic = bag.find_topic(['sensor_msgs/msg/CompressedImage']).name
        return info, [stored.message for stored in bag.messages([topic])]


def back_and_forth(images: Sequence[Any]) -> Iterator[Any]:
    """Images to the last, back to the first, and again."""
    while True:
        yield from images
        yield from images[-2:0:-1]


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """A table for people."""
    rows = [['node', 'rate', 'images', 'results', 'median', '99 %', 'largest', '']]
    for name, found in result.items():
        if name == 'machine':
            continue
        if isinstance(found, str):
            rows.append([name, found, '', '', '', '', '', ''])
            continue
        times = found['latency_ms'].values()
        rows.append(
            [
                name, f'{found["rate_hz"]:g} Hz', str(found['images']), str(found['results']),
                *('' if x is None else f'{x:.1f} ms' for x in times),
                'met' if found['met'] else f'missed, wanted {found["wanted"]}',
            ]
        )  # fmt: skip
    return table(rows, markdown=markdown)


def _ignored(topic: str, stamp: int, data: bytes) -> None:
    """Results are listened to elsewhere."""
