"""The consumers on the page of the documentation: they are compiled, and they run."""

from __future__ import annotations

import os
import re
import shutil
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
# Of a standard deviation of 0.1 m, this is how far one mode is beyond 2 m, and the other before.
WEIGHTS, AWAY, SIGMA = (0.75, 0.25), (0.1, -0.2), 0.1
# 0.75 of 16 % and 0.25 of 98 %.
ANSWER = 'right wrist within 2 m: {}%'

# What the example uses of rclcpp, for machines without it: spinning hands one message over.
RCLCPP = """
#include <cstdio>
#include <functional>
#include <memory>
#include <string>
#include <hmt_msgs/msg/pose_mixture.hpp>
#define RCLCPP_INFO(logger, ...) (void)(logger), std::printf(__VA_ARGS__)
namespace rclcpp {
struct Logger {};
struct Node {
  explicit Node(const std::string &) {}
  Logger get_logger() const {return {};}
  std::function<void(const hmt_msgs::msg::PoseMixture &)> callback;
  template<typename Message, typename Callback>
  std::shared_ptr<int> create_subscription(const std::string &, int, Callback given)
  {
    callback = given;
    return std::make_shared<int>(0);
  }
};
inline void init(int, char **) {}
inline void shutdown() {}
inline void spin(const std::shared_ptr<Node> & node)
{
  hmt_msgs::msg::PoseMixture mixture;
  mixture.state = mixture.STATE_TRACKING;
  mixture.joint_names = {"pelvis", "right_wrist"};
  const double weights[2] = {0.75, 0.25}, depths[2] = {2.1, 1.8};
  for (int k = 0; k < 2; ++k) {
    hmt_msgs::msg::PoseComponent mode;
    mode.weight = weights[k];
    mode.joint_positions.resize(2);
    mode.joint_positions[1].z = depths[k];
    mode.joint_covariances.assign(18, 0.0);
    mode.joint_covariances[17] = 0.01;
    mixture.components.push_back(mode);
  }
  node->callback(mixture);
}
}
"""


def example(language: str) -> str:
    (code,) = re.findall(rf'^```{language}\n(.*?)^```$', PAGE.read_text('utf-8'), re.M | re.S)
    return code


def includes() -> list[str]:
    """Options for the headers of the messages, of all packages of the ROS environment."""
    folders = [Path(x) / 'include' for x in os.environ.get('AMENT_PREFIX_PATH', '').split(':') if x]
    return [
        f'-I{package}' for folder in folders for package in folder.glob('*') if package.is_dir()
    ]


@pytest.mark.ros
def test_consumer_in_cpp(tmp_path):
    compiler = shutil.which('c++')
    if compiler is None:
        pytest.skip('no C++ compiler (c++) in PATH')
    options = includes()
    headers = ('hmt_msgs/msg/pose_mixture.hpp', 'rosidl_runtime_cpp/message_initialization.hpp')
    for header in headers:
        if not any((Path(x[2:]) / header).is_file() for x in options):
            pytest.skip(f'header {header} is not in AMENT_PREFIX_PATH')
    (tmp_path / 'rclcpp').mkdir()
    (tmp_path / 'rclcpp' / 'rclcpp.hpp').write_text(RCLCPP)
    (tmp_path / 'consumer.cpp').write_text(example('cpp'))
    # The stand-in comes before an rclcpp that is installed: nothing is linked.
    command = [compiler, '-std=c++17', '-Wall', '-Wextra', '-Werror', f'-I{tmp_path}', *options]
    built = subprocess.run(
        [*command, 'consumer.cpp', '-o', 'consumer'], cwd=tmp_path, text=True, capture_output=True,
        check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr
    ran = subprocess.run([tmp_path / 'consumer'], text=True, capture_output=True, check=True)
    assert ran.stdout == ANSWER.format(36)


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

    (tmp_path / 'consumer.py').write_text(example('py'))
    assert len(example('py').split('\n\n\n')[1].splitlines()) <= 15
    data = serialise(pose_mixture_message(RosbagsMessages(), wrists()))
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('publisher', context=context)
    namespace = f'/consumed_{os.getpid()}'
    publisher = node.create_publisher(PoseMixtureMessage, f'{namespace}/pose_mixture', 10)
    command = [sys.executable, 'consumer.py', '--ros-args', '-r', f'__ns:={namespace}']
    process = subprocess.Popen(command, cwd=tmp_path, text=True, stdout=subprocess.PIPE)
    timer = node.create_timer(0.1, lambda: publisher.publish(data))
    try:
        executor = rclpy.executors.SingleThreadedExecutor(context=context)
        executor.add_node(node)
        for _ in range(600):
            executor.spin_once(timeout_sec=0.1)
            if publisher.get_subscription_count() and process.poll() is None:
                break
        for _ in range(20):
            executor.spin_once(timeout_sec=0.1)
        process.terminate()
        assert process.communicate(timeout=20)[0].splitlines()[0] == ANSWER.format(
            37
        )  # with the errors of joints
    finally:
        process.kill()
        process.communicate()
        node.destroy_timer(timer)
        node.destroy_node()
        rclpy.shutdown(context=context)
