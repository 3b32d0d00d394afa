"""The case of the soak that sends damaged bytes to a node: on its topics, and as requests."""

from __future__ import annotations

import numpy as np

from benchmarks.mutations import damaged
from benchmarks.soak.outcome import Amount, Outcome
from benchmarks.soak.watched_node import SHORT, Silent, Watched
from hmt_ros.sessions.image_inputs import PREDICTION
from msg_tools.messages.cdr import canonical, serialise


def damaged_bytes(watched: Watched, amount: Amount, outcome: Outcome) -> None:
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
        # A message of no bytes, which no ROS publisher can send, stops a reliable topic in DDS.
        watched.node.publish_bytes(source, damaged(valid[source], rng) or b'\0')
        try:
            handled = watched.answer(SHORT)
        except Silent:
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
