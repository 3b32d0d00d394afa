"""The BME node itself, over DDS."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hmt_ros.nodes.bme_parameters import BmeParameters
from hmt_ros.nodes.declared_parameters import EFFECTS, declared_parameters
from hmt_ros.nodes.parameter_file import read_parameter_file

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / 'hmt_ros' / 'config' / 'bme_node.yaml'
PATIENCE = 60.0  # s


@pytest.fixture
def world(world_of, stub_predictor, background_file):
    from sensor_msgs.msg import CameraInfo, Image

    from hmt_ros.nodes.bme_node import BmeNode

    inputs = {'camera_info': CameraInfo, 'image': Image}

    def make(**values):
        values = {'background_file': str(background_file), 'least_height': 10, **values}
        return world_of(BmeNode, 'bme_node', inputs, **values)

    return make


@pytest.fixture
def running(world, somebody):
    one = world().start()
    one.send('camera_info', somebody.info())
    return one


def values_of(handled, key):
    return [value.value for value in handled.values if value.key == key]


def test_images_become_predictions(running, somebody):
    from hmt_msgs.msg import PoseMixture

    found = []
    running.listen(PoseMixture, 'pose_prediction', found)
    running.spin_until(lambda: running.node._is_wanted('pose_prediction'))
    for message in (somebody.image(0), somebody.empty(1)):
        assert len(values_of(running.send('image', message), 'pose_prediction')) == 1
    running.spin_until(lambda: len(found) == 2)
    assert [len(message.components) for message in found] == [2, 0]
    assert {message.kind for message in found} == {PoseMixture.PREDICTION}


def test_one_image_is_predicted_on_demand(running, somebody):
    from hmt_msgs.srv import PredictPose

    answer = running.call(PredictPose, 'predict_pose', image=running.of_ros(somebody.image(3)))
    assert (answer.success, answer.message) == (True, '')
    assert len(answer.mixture.components) == 2
    compressed = running.of_ros(somebody.compressed(4))
    answer = running.call(PredictPose, 'predict_pose', compressed_image=compressed)
    assert answer.success
    empty = running.call(PredictPose, 'predict_pose')
    assert not empty.success
    assert 'fill image or compressed_image' in empty.message
    nobody = running.call(PredictPose, 'predict_pose', image=running.of_ros(somebody.empty(5)))
    assert not nobody.success
    assert 'nobody is seen' in nobody.message


def test_parameters_are_those_of_the_file(running):
    descriptors = {p.name: p for p in declared_parameters(BmeParameters())}
    assert sorted(read_parameter_file(CONFIG, 'bme_node')) == sorted(descriptors)
    for name, declared in descriptors.items():
        descriptor = running.node.describe_parameter(name)
        assert descriptor.description == f'{declared.description} {EFFECTS[declared.effect]}'
    for values, reason in (
        ({'max_hypotheses': 0}, 'out of range'),
        ({'background_file': 'nowhere.png'}, 'nowhere.png: can not be read'),
        ({'image_transport': 'pigeon'}, "saw 'pigeon'"),
        ({'autostart': False}, 'read-only'),
    ):
        good, why = running.set(**values)
        assert not good
        assert reason in why, why
    assert running.set(max_hypotheses=1, queue_size=3) == (True, '')
    assert running.node._session.parameters.max_hypotheses == 1
    assert running.node._queue._limits['image'] == 3


def test_one_warning_for_each_kind_and_the_node_lives(running, somebody):
    for make, indices in (
        (lambda index: somebody.image(index, size=(32, 24)), (1, 2)),
        (somebody.image, (2, 2)),
        (somebody.image, (0, 1)),
    ):
        for index in indices:
            assert len(values_of(running.send('image', make(index)), 'fault')) == 1
    running.send('camera_info', somebody.uncalibrated())
    assert values_of(running.send('image', somebody.image(9)), 'fault') == []
    wanted = ('32x24 pixels', 'stamps that increase', 'reset_on_time_jump', 'not calibrated')
    running.spin_until(lambda: len(running.warnings()) >= len(wanted))
    for text, part in zip(running.warnings(), wanted, strict=True):
        assert part in text
    _, _, values = running.diagnosis()
    assert (values['images predicted'], values['images skipped']) == ('1', '6')


def test_diagnostics(world, somebody):
    one = world(background_file='', background_images=1).start()
    assert one.diagnosis()[:2] == (1, 'waits for a calibrated camera_info')
    one.send('camera_info', somebody.info())
    one.send('image', somebody.empty(0))
    one.send('image', somebody.image(1))
    one.spin_until(lambda: 'predicting' in one.diagnostics[-1].status[0].message)
    _, _, values = one.diagnosis()
    assert one.diagnostics[-1].status[0].name == 'bme_node: prediction'
    assert values['images without a person'] == '1'
    assert values['height of the silhouette, px'] == '24'


def test_lifecycle(world, somebody):
    from hmt_msgs.srv import PredictPose

    one = world(autostart=False)
    one.node.start()
    assert one.state == 'unconfigured'
    assert one.change_state('configure')
    answer = one.call(PredictPose, 'predict_pose', image=one.of_ros(somebody.image(0)))
    assert 'no calibrated camera_info' in answer.message
    assert one.change_state('activate')
    one.connect()
    one.send('camera_info', somebody.info())
    assert values_of(one.send('image', somebody.image(0)), 'fault') == []
    assert one.change_state('deactivate')
    assert one.change_state('cleanup')
    assert one.state == 'unconfigured'


def test_a_model_that_is_none_is_told(tmp_path):
    path = tmp_path / 'model.npz'
    path.write_bytes(b'garbage')
    node = start_node('-p', f'model_file:={path}')
    try:
        line = next(line for line in node.stdout if 'model.npz' in line)
        assert '[ERROR]' in line
    finally:
        node.send_signal(signal.SIGINT)
        assert node.wait(PATIENCE) == 0


def start_node(*arguments):
    return subprocess.Popen(
        [sys.executable, '-m', 'hmt_ros.nodes.bme_node', '--ros-args', *arguments],
        cwd=ROOT,
        env=dict(os.environ),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_ends_cleanly():
    node = start_node('--params-file', str(CONFIG))
    lines = []
    try:
        for line in node.stdout:
            lines.append(line)
            if 'images from /image' in line:
                node.send_signal(signal.SIGINT)
        assert node.wait(PATIENCE) == 0
    finally:
        node.kill()
    assert len(lines) == 1, lines
