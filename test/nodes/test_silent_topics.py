"""Reports of a node on silent topics: their publishers, and alternatives."""

import re
import time

import pytest

pytestmark = pytest.mark.ros

RAW, JPEG, INFO = (f'sensor_msgs/msg/{name}' for name in ('Image', 'CompressedImage', 'CameraInfo'))


def silent(transport, *published, name='/image'):
    """The reason for silence, given published (topic, type) pairs."""
    from hmt_ros.nodes.silent_topics import Publication, why_silent
    from hmt_ros.nodes.subscribed_topic import image_topic

    found = [Publication(topic, kind, '/driver') for topic, kind in published]
    return why_silent([image_topic(transport)], [name], found)


@pytest.mark.parametrize(
    ('transport', 'published', 'end'),
    [
        ('raw', [], '; nobody publishes it'),
        (
            'raw',
            [('/camera/image_raw', RAW)],
            '; nobody publishes it; there is /camera/image_raw (sensor_msgs/Image): remap with '
            '-r image:=/camera/image_raw',
        ),
        (
            'raw',
            [('/image/compressed', JPEG)],
            '; nobody publishes it; there is /image/compressed (sensor_msgs/CompressedImage): set '
            'image_transport to compressed and remap with -r image/compressed:=/image/compressed',
        ),
        (
            'raw',
            [('/cam/image/compressed', JPEG)],
            '; nobody publishes it; there is /cam/image/compressed (sensor_msgs/CompressedImage): '
            'set image_transport to compressed and remap with -r '
            'image/compressed:=/cam/image/compressed',
        ),
        (
            'raw',
            [('/image', JPEG)],
            '; /driver publishes it as sensor_msgs/CompressedImage; there is /image '
            '(sensor_msgs/CompressedImage): set image_transport to compressed and remap with '
            '-r image/compressed:=/image',
        ),
        (
            'raw',
            [('/image', RAW)],
            '; /driver publishes it, but no message has come: it may wait for something itself, '
            'see its diagnostics and "ros2 topic info --verbose /image"',
        ),
        (
            'raw',
            [(f'/{side}/{what}', RAW) for side in ('left', 'right') for what in ('image', 'mono')],
            '; nobody publishes it; there are /left/image (sensor_msgs/Image), /right/image '
            '(sensor_msgs/Image), /right/mono (sensor_msgs/Image): remap with '
            '-r image:=/left/image',
        ),
    ],
)
def test_the_reason_and_what_there_is_instead(transport, published, end):
    assert silent(transport, *published) == f'nothing on /image (sensor_msgs/Image){end}'


@pytest.fixture
def world(stub_tracker, subject_file, world_of):
    """A filter without publishers, and the warnings that name a topic."""
    from hmt_ros.nodes.filter_node import FilterNode

    def make(inputs=(), **values):
        from importlib import import_module

        kinds = {topic: kind.split('/') for topic, kind in dict(inputs).items()}
        classes = {t: getattr(import_module(f'{k[0]}.msg'), k[2]) for t, k in kinds.items()}
        values.setdefault('subject_file', str(subject_file))
        return world_of(FilterNode, 'filter_node', classes, **values).start()

    return make


def of_topic(one, topic):
    return [text for text in one.warnings() if text.startswith(f'nothing on {topic} ')]


def test_nobody_publishes(world):
    from sensor_msgs.msg import Image

    one = world()
    elsewhere = one.other.create_publisher(Image, '/camera/image_raw', 5)
    one.patience(0.5)
    # Discovery may still know topics of processes that were killed.
    hint = re.compile(r'there (is|are) .*/camera/image_raw \(sensor_msgs/Image\).*: remap with -r ')
    one.spin_until(lambda: any(map(hint.search, of_topic(one, '/image'))), 'the hint')
    one.spin_until(lambda: of_topic(one, '/camera_info'), 'the other hint')
    # The diagnostics also contain it, by topic and as the reason.
    level, message, values = one.diagnosis()
    assert level == 1
    assert message.startswith('waits for a calibrated camera_info; nothing on /image (')
    assert 'nothing on /camera_info (sensor_msgs/CameraInfo); nobody publishes it' in message
    assert values['nothing on /image'] in of_topic(one, '/image')
    # It is repeated only after some time.
    count = len(of_topic(one, '/image'))
    for _ in range(3):
        one.diagnosis()
    assert len(of_topic(one, '/image')) == count
    one.other.destroy_publisher(elsewhere)


def test_what_arrives_is_not_told(world, small_camera):
    one = world({'image': RAW, 'camera_info': INFO})
    one.own_periods()
    one.send('camera_info', small_camera.info())
    one.send('image', small_camera.image(0))
    # It has listened for a long time, and has the calibration, which is needed only once.
    silent, long_ago = one.node._silent, time.monotonic() - 1e4
    silent._began = long_ago
    for source in ('camera_info', 'image'):
        silent.arrived(source, long_ago)
    one.patience(1e3)
    one.send('image', small_camera.image(1))
    assert one.diagnosis()[0] == 0
    assert of_topic(one, '/image') == of_topic(one, '/camera_info') == []
    silent.arrived('image', long_ago)
    one.diagnosis()
    assert len(of_topic(one, '/image')) == 1
