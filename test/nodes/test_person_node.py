"""Nodes in one process: the same topics and bytes, without DDS in between."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hmt_ros.sessions.image_inputs import PREDICTION
from msg_tools.messages.cdr import serialise
from test.nodes.conftest import PATIENCE

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def together(stub_tracker, stub_predictor, background_file):
    """Filter, smoother and experts of one process, an executor, and a node that talks to them."""
    import rclpy
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.parameter import Parameter

    from hmt_ros.nodes.person_node import USUAL_NODES, nodes_together

    context = rclpy.Context()
    rclpy.init(context=context)
    reliable = {
        f'qos_overrides./{topic}.subscription.reliability': 'reliable'
        for topic in ('image', 'camera_info')
    }
    values = {'background_file': str(background_file), **reliable}
    made = []

    def make(**more):
        overrides = [Parameter(k, value=v) for k, v in {**values, **more}.items()]
        made.extend(nodes_together(USUAL_NODES, context=context, parameter_overrides=overrides))
        executor = SingleThreadedExecutor(context=context)
        other = rclpy.create_node('other', context=context)
        for node in (*made, other):
            executor.add_node(node)
        for node in made:
            node.start()
        made.append(other)
        return {node.get_name(): node for node in made}, other, executor

    yield make
    for node in made:
        if hasattr(node, 'stop'):
            node.stop()
        node.destroy_node()
    rclpy.shutdown(context=context)


def spin_until(executor, done, what):
    end = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < end, f'waited in vain for {what}'
        executor.spin_once(timeout_sec=0.05)


def state_of(node):
    return node._session.state


def subscribed(node):
    """Topics that a node receives over DDS."""
    return {one.topic_name for one in node.subscriptions}


def camera_of(other, executor):
    """Publishers of a camera, once the nodes' image subscription is connected."""
    from sensor_msgs.msg import CameraInfo, Image

    publishers = {
        'camera_info': other.create_publisher(CameraInfo, 'camera_info', 100),
        'image': other.create_publisher(Image, 'image', 100),
    }
    spin_until(
        executor,
        lambda: all(p.get_subscription_count() == 1 for p in publishers.values()),
        'a subscription',
    )
    return publishers


def test_what_one_publishes_the_next_gets_without_dds(together, small_camera):
    from hmt_msgs.msg import PoseMixture

    nodes, other, executor = together()
    came = []
    other.create_subscription(PoseMixture, 'pose_mixture', came.append, 100)
    publishers = camera_of(other, executor)
    # Nobody subscribes to predictions over DDS.
    assert other.count_subscribers(PREDICTION) == 0
    assert other.count_subscribers('likelihood_mixture') == 0
    spin_until(executor, lambda: other.count_publishers('pose_mixture') == 1, 'a publisher')
    publishers['camera_info'].publish(serialise(small_camera.info()))
    spin_until(
        executor,
        lambda: (
            not any(
                'camera_info' in state_of(nodes[name]).wants for name in ('filter_node', 'bme_node')
            )
        ),
        'the calibration',
    )
    for index in range(4):
        publishers['image'].publish(serialise(small_camera.image(index)))
        spin_until(executor, lambda n=index: len(came) > n, 'a mixture')
    assert [len(message.components) for message in came] == [2] * 4
    smoother = nodes['smoother_node']
    spin_until(executor, lambda: state_of(smoother).counts['smoothed'] == 4, 'smoothing')
    assert nodes['bme_node']._subscribers(PREDICTION) == 1


def in_lock_step(together, small_camera, kinds, count=6):
    """Bytes by topic from nodes in one process, and from separate sessions linked by bytes."""
    from importlib import import_module

    nodes, other, executor = together()
    came = {topic: [] for topic in kinds}
    for topic, name in kinds.items():
        kind = getattr(import_module('hmt_msgs.msg'), name)
        other.create_subscription(kind, topic, came[topic].append, 100, raw=True)
    publishers = camera_of(other, executor)
    filter_node, bme_node = nodes['filter_node'], nodes['bme_node']
    spin_until(
        executor,
        lambda: (
            all(other.count_publishers(topic) == 1 for topic in kinds)
            and filter_node._outputs['pose_mixture'].get_subscription_count() == 1
        ),
        'subscriptions',
    )
    publishers['camera_info'].publish(serialise(small_camera.info()))
    for index in range(count):
        publishers['image'].publish(serialise(small_camera.image(index)))
        spin_until(
            executor,
            lambda n=index: state_of(nodes['smoother_node']).counts['smoothed'] > n,
            'smoothing',
        )
        # The experts have received the track.
        spin_until(executor, lambda: not len(bme_node._estimator.queue), 'the track')
    nodes['smoother_node'].trigger_deactivate()
    spin_until(executor, lambda: len(came['smoothed_pose_mixture']) == count, 'the end')
    settings = {name: nodes[name]._settings for name in nodes if name != 'other'}
    return came, settings


def test_the_bytes_are_those_of_nodes_in_processes_of_their_own(together, small_camera):
    """Objects passed directly and serialised messages have the same results."""
    from hmt_ros.nodes.person_node import NODES
    from msg_tools.messages.cdr import deserialise

    count = 6
    names = {'pose_prediction': 'PoseMixture', 'pose_mixture': 'PoseMixture'}
    names['smoothed_pose_mixture'] = 'PoseMixture'
    came, settings = in_lock_step(together, small_camera, names, count)
    made = {topic: [] for topic in names}
    sessions = {}
    heard = {
        'pose_prediction': ['filter_node'],
        'pose_mixture': ['bme_node'],
        'likelihood_mixture': ['smoother_node'],
    }

    def publish(output):
        if output.topic in made:
            made[output.topic].append(output.data)
        for name in heard.get(output.topic, ()):
            message = deserialise(output.data, 'hmt_msgs/msg/PoseMixture')
            sessions[name].take(output.topic, message)

    for name, parameters in settings.items():
        sessions[name] = NODES[name].SESSION(parameters, publish)
    for name in ('bme_node', 'filter_node'):
        sessions[name].take('camera_info', small_camera.info())
    for index in range(count):
        for name in ('bme_node', 'filter_node'):
            sessions[name].take('image', small_camera.image(index))
    sessions['smoother_node'].finish()
    assert [len(made[topic]) for topic in names] == [count] * 3
    for topic, own in made.items():
        # The middleware is allowed to pad the end.
        pairs = zip(came[topic], own, strict=True)
        assert [data[: len(each)] for data, each in pairs] == own


def test_parameters_follow_from_who_is_there():
    from hmt_ros.nodes.person_node import USUAL_NODES, used_of_each_other

    assert used_of_each_other(USUAL_NODES) == {
        'filter_node': {'use_predictions': True},
        'smoother_node': {},
        'bme_node': {'tracked_interval': 0.2},
    }
    assert used_of_each_other(['filter_node', 'keypoints_node'])['filter_node'] == {
        'use_keypoints': True,
        'use_keypoints_3d': True,
    }
    assert used_of_each_other(['bme_node']) == {'bme_node': {}}


def test_a_node_that_is_deactivated_leaves_the_images_to_the_others(together, small_camera):
    from sensor_msgs.msg import CameraInfo, Image

    nodes, other, executor = together()
    info = other.create_publisher(CameraInfo, 'camera_info', 100)
    image = other.create_publisher(Image, 'image', 100)
    for publisher in (info, image):
        spin_until(executor, lambda p=publisher: p.get_subscription_count() == 1, 'a subscription')
    owner = next(
        node for node in nodes.values() if node is not other and '/image' in subscribed(node)
    )
    (left,) = {'filter_node', 'bme_node'} - {owner.get_name()}
    owner.trigger_deactivate()
    spin_until(executor, lambda: image.get_subscription_count() == 1, 'the other subscription')
    time.sleep(0.2)
    info.publish(serialise(small_camera.info()))
    image.publish(serialise(small_camera.image(0)))
    spin_until(executor, lambda: state_of(nodes[left]).counts['received'] == 1, 'the image')
    assert {'/image', '/camera_info'} <= subscribed(nodes[left])
    assert subscribed(owner).isdisjoint({'/image', '/camera_info'})


def run(*words, stop_at=''):
    """Runs the executable, up to a text if given; returns its exit code and output."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'hmt_ros.nodes.person_node', *words],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    lines = []
    for line in process.stdout:
        lines.append(line)
        if stop_at and stop_at in line:
            process.send_signal(signal.SIGINT)
            stop_at = ''
    return process.wait(PATIENCE), ''.join(lines)


def test_the_process_starts_and_ends_well():
    code, said = run(
        'smoother_node', 'keypoints_node', '--ros-args', '-r', '__ns:=/humans/bodies/p7',
        stop_at='mixtures from',
    )  # fmt: skip
    assert code == 0, said
    assert '[humans.bodies.p7.smoother_node]' in said


@pytest.mark.parametrize(
    ('words', 'text'),
    [
        (['--help'], 'usage: ros2 run hmt_ros person_node [NODE ...]'),
        (
            ['smother_node'],
            'wanted some of filter_node, smoother_node, bme_node, keypoints_node, saw',
        ),
        (['--ros-args', '-r', '__node:=mine'], '__node:=mine would give all nodes one name'),
    ],
)
def test_the_command_line(words, text, ended):
    code, output, errors = ended('person_node', *words)
    assert code == (0 if '--help' in words else 2)
    assert text in output + errors
