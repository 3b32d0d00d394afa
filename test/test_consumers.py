"""The consumer in Python on the page of the documentation runs; C++: see test_workspace.py."""

from __future__ import annotations

import os
import re
import select
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.inference import GaussianMixture
from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import serialise
from msg_tools.messages.pose_mixtures import (
    MixtureKind,
    PoseMixture,
    TrackState,
    pose_mixture_message,
)

PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'consumers.md'
# Distances of the two modes beyond 2 m, in m, and their standard deviation.
WEIGHTS, AWAY, SIGMA = (0.75, 0.25), (0.1, -0.2), 0.1
# 0.75 times 16 % plus 0.25 times 98 %.
ANSWER = 'right wrist within 2 m: {}%'


def example() -> str:
    (code,) = re.findall(r'^```py\n(.*?)^```$', PAGE.read_text('utf-8'), re.M | re.S)
    return code


def wrists() -> PoseMixture:
    """Two modes whose right wrists are where `AWAY` says, with the deviation `SIGMA` of depth."""
    body = load_body('human37')
    wrist = body.joint_names.index('right_wrist')
    means = np.tile(body.prior_mean, (2, 1))
    means[:, 2] = 4.0
    means[:, 2] += 2.0 + np.array(AWAY) - body.joint_positions(means)[:, wrist, 2]
    covariance = 1e-12 * np.eye(body.dimension)
    covariance[2, 2] = SIGMA**2
    mixture = GaussianMixture(WEIGHTS, means, np.tile(covariance, (2, 1, 1)))
    return PoseMixture.of_body(
        body, mixture, MixtureKind.POSTERIOR, 10**18, 'lens', state=TrackState.TRACKING
    )


@pytest.mark.ros
def test_consumer_in_python(tmp_path):
    import rclpy
    from hmt_msgs.msg import PoseMixture as PoseMixtureMessage

    (tmp_path / 'consumer.py').write_text(example())
    data = serialise(pose_mixture_message(RosbagsMessages(), wrists()))
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('publisher', context=context)
    namespace = f'/consumed_{os.getpid()}'
    publisher = node.create_publisher(PoseMixtureMessage, f'{namespace}/pose_mixture', 10)
    command = [sys.executable, '-u', 'consumer.py', '--ros-args', '-r', f'__ns:={namespace}']
    process = subprocess.Popen(command, cwd=tmp_path, text=True, stdout=subprocess.PIPE)
    timer = node.create_timer(0.1, lambda: publisher.publish(data))
    try:
        executor = rclpy.executors.SingleThreadedExecutor(context=context)
        executor.add_node(node)
        for _ in range(600):
            executor.spin_once(timeout_sec=0.1)
            if select.select([process.stdout], [], [], 0.0)[0]:
                break
        # rclpy.spin misses one SIGTERM in some hundreds.
        process.kill()
        assert process.communicate(timeout=20)[0].splitlines()[0] == ANSWER.format(
            37
        )  # with the errors of joints
    finally:
        process.kill()
        process.communicate()
        node.destroy_timer(timer)
        node.destroy_node()
        rclpy.shutdown(context=context)
