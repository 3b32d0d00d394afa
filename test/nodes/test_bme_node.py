"""The BME node over DDS."""

import pytest

from hmt_ros.sessions.bme_parameters import BmeParameters

pytestmark = pytest.mark.ros


@pytest.fixture
def world(world_of, stub_predictor, background_file):
    from sensor_msgs.msg import CameraInfo, Image

    from hmt_ros.nodes.bme_node import BmeNode

    inputs = {'camera_info': CameraInfo, 'image': Image}

    def make(**values):
        values = {'background_file': str(background_file), **values}
        return world_of(BmeNode, 'bme_node', inputs, **values)

    return make


@pytest.fixture
def running(world, somebody):
    one = world().start()
    one.send('camera_info', somebody.info())
    return one


def test_images_become_predictions(running, somebody):
    from hmt_msgs.msg import PoseMixture

    found = running.hear({'pose_prediction': PoseMixture})['pose_prediction']
    for message in (somebody.image(0), somebody.empty(1)):
        ((topic, _),) = running.send('image', message).published
        assert topic == 'pose_prediction'
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
    running.assert_described(BmeParameters())
    running.assert_refused(
        ({'max_hypotheses': 0}, 'out of range'),
        ({'background_file': 'nowhere.png'}, 'nowhere.png: no such file'),
        ({'image_transport': 'pigeon'}, "saw 'pigeon'"),
        ({'autostart': False}, 'read-only'),
    )
    assert running.set(max_hypotheses=1, queue_size=3) == (True, '')
    assert running.session.parameters.max_hypotheses == 1
    assert running.limit('image') == 3
