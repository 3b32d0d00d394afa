"""nodes: latency added by ROS and DDS, with a node whose estimate costs nothing."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np

import hmt_ros
from benchmarks.camera import with_stamp
from benchmarks.clips import COMPRESSED, ROOT, index_back_and_forth, read_messages, table
from benchmarks.command import add_choice, benchmark_parser, run_stages, show
from hmt_ros.app.replay.live_node import LiveNode
from hmt_ros.app.replay.player import LiveNodeError, Player
from hmt_ros.sessions import bme_session
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.camera_session import CAMERA_INFO, IMAGE
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import compressed_image_message, decode_image, image_message

RATE = 30.0  # images per second
SECONDS, QUICK_SECONDS = 20.0, 1.0
WARM_UP = 10  # number of images before the measurement
PATIENCE = 2.0  # wait after the last image, s; much longer for the first
SIZE, IMAGES = (640, 480), 30
MEDIAN_MS, LATE_MS = 5.0, 15.0  # maximum added latency, median and 99th percentile
# Queue size, because images come in bursts although no node is late.
QUEUE = 5
FIRST_NS, STEP_NS = 10**18, round(1e9 / RATE)
# Profile of DDS with enough shared memory for raw images.
PROFILE = Path(hmt_ros.__file__).parent / 'config' / 'fastdds.xml'
TRANSPORTS = {'raw': 'ROS alone, 640x480 bgr8', 'compressed': 'ROS alone, 640x480 JPEG'}


def main(argv: list[str]) -> int:
    """Runs the benchmark."""
    parser = benchmark_parser('nodes', __doc__, quick='a second of raw images')
    add_choice(parser, tuple(TRANSPORTS), 'TRANSPORT')
    options = parser.parse_args(argv)
    result = measure(tuple(options.only), quick=options.quick)
    return show(result, as_text, as_json=options.json)


def measure(only: tuple[str, ...] = tuple(TRANSPORTS), *, quick: bool = False) -> dict[str, Any]:
    """Latency and losses of images at camera rate, by transport."""
    seconds = QUICK_SECONDS if quick else SECONDS
    stages = {name: partial(_tried, name, seconds) for name in TRANSPORTS}
    with patch.dict(os.environ, {'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROFILE)}):
        return run_stages('nodes', stages, only[:1] if quick else only)


def _tried(transport: str, seconds: float) -> dict[str, Any] | str:
    try:
        return added(transport, seconds)
    except LiveNodeError as error:
        return f'skipped: {error}'


def added(transport: str, seconds: float) -> dict[str, Any]:
    """Publishes images to the node, forwards and backwards, and listens to its predictions."""
    with ExitStack() as opened:
        player = Player(opened)
        one = _Heard(transport, player, opened)
        for number in range(WARM_UP):
            one.show(number)
            one.wait(player)
        first, number = time.perf_counter(), 0
        while time.perf_counter() < first + seconds:
            while (left := first + number / RATE - time.perf_counter()) > 0:
                player.executor.spin_once(timeout_sec=left)
            one.show(WARM_UP + number)
            number += 1
        end = time.perf_counter() + PATIENCE
        while time.perf_counter() < end and len(one.arrived) < len(one.sent):
            player.executor.spin_once(timeout_sec=0.05)
        one.node.stop_well()
    counted = sorted(one.sent)[WARM_UP:]
    delays = 1e3 * np.array([one.arrived[x] - one.sent[x] for x in counted if x in one.arrived])
    if not len(delays):
        raise LiveNodeError('no image was answered')
    median, late = (float(np.percentile(delays, p)) for p in (50, 99))
    return {
        'images': len(counted),
        'results': len(delays),
        'latency_ms': {'median': median, '99 %': late, 'largest': float(delays.max())},
        'wanted': f'{MEDIAN_MS:g} ms median, {LATE_MS:g} ms at 99 %, none lost',
        'met': len(delays) == len(counted) and median <= MEDIAN_MS and late <= LATE_MS,
    }


class _Heard:
    """The node, with times of its images and results."""

    def __init__(self, transport: str, player: Player, opened: ExitStack) -> None:
        self.sent: dict[int, float] = {}
        self.arrived: dict[int, float] = {}
        info, images = _shown(transport)
        self._data = [serialise(image) for image in images]
        raw = transport == 'raw'
        topic, kind = ('image', 'Image') if raw else ('image/compressed', 'CompressedImage')
        result = bme_session.PREDICTION
        self.node = LiveNode(
            player,
            opened,
            'bme_node',
            BmeParameters(image_transport=transport, queue_size=QUEUE),
            inputs={
                CAMERA_INFO: ('camera_info', 'sensor_msgs/msg/CameraInfo'),
                IMAGE: (topic, f'sensor_msgs/msg/{kind}'),
            },
            topics={},
            module='benchmarks.prompt_node',
            write=_ignored,
        )

        def heard(data: bytes) -> None:
            # The timestamp comes first; deserialising the rest would take longer than receiving it.
            now = time.perf_counter()
            seconds, nanoseconds = np.frombuffer(data, '<i4', 2, 4).tolist()
            self.arrived[seconds * 10**9 + nanoseconds] = now

        message = player.classes[bme_session.TOPICS[result].msgtype]
        player.node.create_subscription(message, result, heard, player.reliable, raw=True)
        self.node.wait_until_active()
        self.node.wait_for_subscribers((result,), 1)
        self.node.publish(CAMERA_INFO, info)

    def show(self, number: int) -> None:
        """Publishes an image."""
        stamp = FIRST_NS + number * STEP_NS
        data = self._data[index_back_and_forth(number, len(self._data))]
        self.sent[stamp] = time.perf_counter()
        self.node.publish_bytes(IMAGE, with_stamp(data, stamp))

    def wait(self, player: Player) -> None:
        """Waits until the last image is answered or lost."""
        stamp = next(reversed(self.sent))
        end = time.perf_counter() + (PATIENCE if self.arrived else 15 * PATIENCE)
        while stamp not in self.arrived and time.perf_counter() < end:
            player.executor.spin_once(timeout_sec=0.05)


def _shown(transport: str) -> tuple[Any, Sequence[Any]]:
    """Calibration and images of the usual size."""
    messages, images = RosbagsMessages(), []
    info, recorded = read_messages(ROOT / 'bags' / 'reach', [COMPRESSED], IMAGES)
    made: Callable[..., Any] = image_message if transport == 'raw' else compressed_image_message
    for message in recorded:
        picture = np.asarray(cv2.resize(decode_image(message), SIZE), np.uint8)
        images.append(made(messages, picture, time_ns(message.header.stamp), 'lens'))
    return replace(info, width=SIZE[0], height=SIZE[1]), images


def as_text(result: dict[str, Any], *, markdown: bool = False) -> str:
    """Human-readable table."""
    rows = [['30 images a second', 'images', 'results', 'median', '99 %', 'largest', '']]
    for transport, what in TRANSPORTS.items():
        found = result.get(transport)
        if isinstance(found, str):
            rows.append([what, found, '', '', '', '', ''])
        elif found is not None:
            times = [f'{x:.1f} ms' for x in found['latency_ms'].values()]
            verdict = ('met: ' if found['met'] else 'missed, wanted ') + found['wanted']
            rows.append([what, str(found['images']), str(found['results']), *times, verdict])
    return table(rows, markdown=markdown)


def _ignored(topic: str, stamp: int, data: bytes) -> None:
    """Ignored, because results are received elsewhere."""
