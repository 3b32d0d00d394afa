"""The filter node over DDS, with a stub tracker."""

import re
import signal
import threading
import time
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from hmt_ros.nodes import session_node
from hmt_ros.sessions.tracking_parameters import FilterParameters
from msg_tools.messages.cdr import serialise
from test.nodes.conftest import PATIENCE, only_line

pytestmark = pytest.mark.ros

ROOT = Path(__file__).resolve().parents[2]
# Published at the start of a track, with or without subscribers.
STARTS = ['body', 'human_description']
CONFIG = ROOT / 'hmt_ros' / 'config' / 'filter_node.yaml'


@pytest.fixture
def world(stub_tracker, subject_file, world_of):
    from hmt_msgs.msg import Keypoints2D
    from sensor_msgs.msg import CameraInfo, CompressedImage, Image

    from hmt_ros.nodes.filter_node import FilterNode

    inputs = {
        'image': Image,
        'camera_info': CameraInfo,
        'keypoints': Keypoints2D,
        'mask': Image,
        'mask/compressed': CompressedImage,
    }

    def make(**values):
        values.setdefault('subject_file', str(subject_file))
        return world_of(FilterNode, 'filter_node', inputs, **values)

    return make


@pytest.fixture
def running(world):
    return world().start()


def faults(handled):
    return list(handled.faults)


def published(handled):
    return [topic for topic, _ in handled.published]


@pytest.fixture
def held_estimate(stub_tracker, monkeypatch, world):
    """Two events: an estimate has begun, and estimates are allowed to continue."""
    begun, go = threading.Event(), threading.Event()
    step = stub_tracker.step

    def slow(self, *arguments, **named):
        begun.set()
        assert go.wait(PATIENCE)
        return step(self, *arguments, **named)

    monkeypatch.setattr(stub_tracker, 'step', slow)
    yield begun, go
    go.set()


def test_images_become_messages(running, small_camera):
    from hmt_msgs.msg import Body, PoseMixture
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from std_msgs.msg import String
    from tf2_msgs.msg import TFMessage

    bodies, descriptions = [], []
    mixtures, transforms = running.hear({'pose_mixture': PoseMixture, '/tf': TFMessage}).values()
    running.send('camera_info', small_camera.info())
    first = running.send('image', small_camera.image(0))
    assert first.source == 'image'
    assert first.stamp_ns == small_camera.stamp(0)
    # Topics without subscribers are not produced.
    assert published(first) == [*STARTS, 'pose_mixture', '/tf']
    assert published(running.send('image', small_camera.image(1))) == ['pose_mixture', '/tf']
    running.spin_until(lambda: len(mixtures) == 2 and len(transforms) == 2)
    assert [len(m.components) for m in mixtures] == [2, 2]
    assert mixtures[0].header.frame_id == 'lens'
    assert transforms[0].transforms[0].header.frame_id == 'lens'
    # The body is latched for late subscribers.
    late = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    running.listen(Body, 'body', bodies, late)
    running.listen(String, 'human_description', descriptions, late)
    running.spin_until(lambda: len(bodies) == len(descriptions) == 1)
    assert bodies[0].name == 'human37'
    # The URDF is published in the person's namespace, never as the robot's.
    robot = ET.fromstring(descriptions[0].data)
    links = {link.attrib['name'] for link in robot.findall('link')}
    assert links - {'lens'} == {t.child_frame_id for t in transforms[1].transforms}
    assert running.other.count_publishers('/robot_description') == 0


def test_nothing_is_taken_for_a_robot(running, small_camera):
    """Without a namespace, too."""
    names = {name for name, _ in running.other.get_topic_names_and_types()}
    assert '/human_joint_states' in names
    assert names.isdisjoint({'/joint_states', '/robot_description'})
    assert running.node.get_parameter('frame_prefix').value == 'human/'


def test_frames_of_a_person_have_the_namespace(running):
    from hmt_ros.nodes.filter_node import FilterNode

    node = FilterNode(namespace='/humans/bodies/anna', context=running.node.context)
    assert node.get_parameter('frame_prefix').value == 'humans/bodies/anna/'
    node.destroy_node()


def test_parameters_are_those_of_the_file(running):
    of_ros = ('use_sim_time', 'start_type_description_service')
    names = [
        name
        for name in running.node.get_parameters_by_prefix('')
        if name not in of_ros and not name.startswith('qos_overrides.')
    ]
    parameters = running.assert_described(FilterParameters())
    assert sorted(names) == sorted(parameters)
    for name, declared in parameters.items():
        if name != 'subject_file':
            wanted = declared.default
            wanted = list(wanted) if isinstance(wanted, tuple) else wanted
            assert running.node.get_parameter(name).value == wanted
        descriptor = running.node.describe_parameter(name)
        ranges = [*descriptor.integer_range, *descriptor.floating_point_range]
        assert [(r.from_value, r.to_value) for r in ranges] == (
            [declared.limits] if declared.limits else []
        )


def test_wrong_values_are_refused_with_a_reason(running):
    running.assert_refused(
        ({'max_hypotheses': 0}, 'out of range. Min: 1, Max: 64, value: 0'),
        ({'subject_file': 'none.yaml'}, 'none.yaml: no such file'),
        ({'background_file': 'two\nlines'}, 'two lines: no such file'),
        ({'body_model': 'nobody'}, 'nobody: no such file, nor a known name; these are human32'),
        ({'autostart': False}, 'read-only'),
        ({'max_hypotheses': 8.0}, 'type'),
    )
    before = FilterParameters()
    assert running.session.parameters.tracker == before.tracker
    assert running.set(max_hypotheses=20, evaluation_budget=800, queue_size=2) == (True, '')
    assert running.session.parameters.tracker.max_hypotheses == 20
    assert running.limit('image') == 2


def test_one_warning_for_each_kind_and_the_node_lives(running, small_camera, stub_tracker):
    def of_unknown_encoding(index):
        image = small_camera.image(index)
        image.encoding = 'yuv9'
        return image

    def of_another_size(index):
        return small_camera.image(index, size=(32, 24))

    for _ in range(3):
        running.send('camera_info', small_camera.uncalibrated())
    running.send('camera_info', small_camera.info())
    assert faults(running.send('image', small_camera.image(2))) == []
    for make, indices in (
        (small_camera.image, (2, 2)),
        (small_camera.image, (1, 0)),
        (of_unknown_encoding, (3, 4)),
        (of_another_size, (5, 6)),
    ):
        for index in indices:
            assert len(faults(running.send('image', make(index)))) == 1
    running.set(use_keypoints=True)
    for index in (7, 8):
        wrong = small_camera.keypoints(index, names=('head', 'neck'), u=np.array([np.nan, 1.0]))
        assert len(faults(running.send('keypoints', wrong))) == 1
    assert faults(running.send('image', small_camera.image(8))) == []
    running.set(use_keypoints=False, use_mask=True)
    for index in (9, 10):
        assert len(faults(running.send('mask', small_camera.mask(index, fill=255)))) == 1
        assert faults(running.send('image', small_camera.image(index))) == []
    assert faults(running.send('mask/compressed', small_camera.compressed_mask(11))) == []
    assert faults(running.send('image', small_camera.image(11))) == []
    assert stub_tracker.made[-1].masks[-1].sum() == 240
    wanted = (
        'camera_info on /camera_info has k[0] = 0: uncalibrated; calibrate the camera',
        'wanted stamps that increase',
        'with reset_on_time_jump the track would start again',
        "encoding 'yuv9' is not known",
        'has 32x24 pixels, wanted the 64x48',
        'keypoint head lies at (nan',
        'is zero nowhere, wanted zero where the person is not',
    )
    running.spin_until(lambda: len(running.warnings()) >= len(wanted))
    for text, part in zip(running.warnings(), wanted, strict=True):
        assert part in text
        assert '\n' not in text
    _, _, values = running.diagnosis()
    assert values['images tracked'] == '5'
    assert values['images skipped'] == '8'
    assert values['faults: camera_info'] == '3'
    assert values['faults: keypoints'] == '2'
    assert values['faults: mask'] == '2'


def test_faults_of_our_own_do_not_end_the_node(running, small_camera, stub_tracker):
    running.send('camera_info', small_camera.info())
    running.send('image', small_camera.image(0))
    stub_tracker.fault = TypeError('a fault of ours')
    told = faults(running.send('image', small_camera.image(1)))
    assert told == ['the node itself failed: TypeError: a fault of ours']
    assert len(running.warnings()) == 1
    (line,) = running.warnings()[0].splitlines()
    assert 'TypeError: a fault of ours; --log-level debug shows where' in line
    values = running.diagnosis()[2]
    assert values['errors of the node itself'] == '1'
    assert values['last error of the node itself'] == 'TypeError: a fault of ours'
    stub_tracker.fault = None
    assert faults(running.send('image', small_camera.image(2))) == []
    assert len(stub_tracker.made) == 2


def test_lifecycle(world, small_camera):
    from hmt_msgs.srv import Reset

    one = world(autostart=False)
    one.node.start()
    assert one.state == 'unconfigured'
    assert one.publishers['image'].get_subscription_count() == 0
    assert not one.change_state('activate')
    one.spin_until(lambda: len(one.warnings()) == 1)
    assert 'transition 3 is not possible' in one.warnings()[0]
    assert one.change_state('configure')
    assert one.state == 'inactive'
    answer = one.call(Reset, 'reset')
    assert (answer.success, answer.message) == (False, 'the node is not active')
    assert one.change_state('activate')
    one.connect()
    one.send('camera_info', small_camera.info())
    one.send('image', small_camera.image(0))
    assert one.change_state('deactivate')
    assert one.state == 'inactive'
    one.spin_until(lambda: one.publishers['image'].get_subscription_count() == 0)
    assert one.change_state('activate')
    one.connect()
    # Track and camera have not changed.
    assert faults(one.send('image', small_camera.image(1))) == []
    assert one.session.state.counts['tracked'] == 2
    assert one.change_state('deactivate')
    assert one.change_state('cleanup')
    assert one.state == 'unconfigured'
    assert one.session is None
    assert one.change_state('configure')
    assert one.change_state('activate')
    assert one.change_state('active_shutdown')
    assert one.state == 'finalized'


def test_node_without_its_subject_lives(world, subject_file, small_camera):
    missing = subject_file.with_name('missing.yaml')
    one = world(subject_file=str(missing), file_folders=str(subject_file.parent))
    one.node.start()
    assert one.state == 'unconfigured'
    one.spin_until(lambda: len(one.warnings()) == 1)
    assert one.warnings() == [
        f'subject_file: {missing}: can not be read (No such file or directory); fix that, '
        'then: ros2 lifecycle set /filter_node configure; ros2 lifecycle set /filter_node activate'
    ]
    assert one.diagnosis()[:2] == (2, one.warnings()[0])
    assert one.set(subject_file=str(subject_file)) == (True, '')
    assert one.change_state('configure')
    assert one.change_state('activate')
    one.connect()
    one.send('camera_info', small_camera.info())
    assert published(one.send('image', small_camera.image(0))) == STARTS


def test_reset(running, small_camera, stub_tracker, subject_file, body):
    from hmt_msgs.msg import PoseComponent, PoseMixture
    from hmt_msgs.srv import Reset

    running.send('camera_info', small_camera.info())
    running.send('image', small_camera.image(0))
    answer = running.call(Reset, 'reset')
    assert answer.success
    assert answer.message.startswith('a new track waits for an image of ')
    assert published(running.send('image', small_camera.image(1))) == STARTS
    assert len(stub_tracker.made) == 2
    mixture = PoseMixture(
        body_model='human37',
        dof_names=list(body.dof_names),
        components=[
            PoseComponent(
                weight=1.0,
                mean=body.prior_mean.tolist(),
                covariance=np.eye(body.dimension).reshape(-1).tolist(),
            )
        ],
    )
    assert running.call(Reset, 'reset', initial=mixture).success
    running.send('image', small_camera.image(2))
    assert np.array_equal(stub_tracker.made[2].start.means, [body.prior_mean])
    mixture.components[0].weight = 0.5
    answer = running.call(Reset, 'reset', initial=mixture)
    assert (answer.success, answer.message) == (
        False,
        'mixture has weights that sum to 0.5, wanted 1',
    )
    subject_file.write_text(
        'stamp_ns: 1\nkeypoints: {haed: [1, 2], a: [1, 2], b: [1, 2], c: [1, 2]}'
    )
    answer = running.call(Reset, 'reset')
    assert not answer.success
    assert answer.message.endswith(
        f'{subject_file}: not a subject; an offline replay with it says why'
    )
    running.send('image', small_camera.image(3))
    assert len(stub_tracker.made) == 3


def test_late_node_drops_the_oldest_and_answers_meanwhile(
    world, small_camera, stub_tracker, held_estimate
):
    begun, go = held_estimate
    one = world(queue_size=2).start()
    end_period = one.own_periods()
    one.send('camera_info', small_camera.info())
    queue = one.estimator.queue

    def waiting_and_dropped():
        return len(queue), queue._dropped

    for index in range(12):
        one.publishers['image'].publish(serialise(small_camera.image(index)))
        one.spin_until(begun.is_set, 'the estimate of the first image')
        one.spin_until(lambda index=index: sum(waiting_and_dropped()) == index)
    assert waiting_and_dropped() == (2, 9)
    assert one.state == 'active'
    assert one.set(publish_tf=False) == (True, '')
    go.set()
    one.spin_until(lambda: one.session.state.counts['tracked'] == 3)
    stamps = [stamp for stamp, _ in stub_tracker.made[0].seen]
    assert stamps == [small_camera.stamp(index) for index in (0, 10, 11)]
    assert one.session.state.counts == {'received': 12, 'tracked': 3, 'dropped': 9}
    # Every image is answered, dropped ones with their timestamps.
    one.spin_until(lambda: sum(h.source == 'image' for h in one.handled) == 12)
    dropped = [h for h in one.handled if h.source == 'image' and h.faults]
    assert [h.stamp_ns for h in dropped] == [small_camera.stamp(i) for i in range(1, 10)]
    assert 'is dropped: newer ones came before its turn' in dropped[0].faults[0]
    assert not any(h.warnings for h in dropped)
    end_period()
    late = re.compile(r'computing takes \d+ ms for one of the images; late: 9 images dropped in a')
    one.spin_until(lambda: any(late.match(d.status[0].message) for d in one.diagnostics))
    level, _, values = one.diagnosis()
    assert values['images dropped'] == '9'
    assert level in (0, 1)


def test_late_node_goes_on_with_the_newest_complete_image(
    world, small_camera, stub_tracker, held_estimate
):
    begun, go = held_estimate
    one = world(use_keypoints=True).start()
    one.send('camera_info', small_camera.info())
    queue = one.estimator.queue
    sent = 0

    def publish(source, index):
        nonlocal sent
        one.publishers[source].publish(serialise(getattr(small_camera, source)(index)))
        sent += 1

    publish('image', 0)
    publish('keypoints', 0)
    one.spin_until(begun.is_set, 'the estimate of the first image')
    sent = 0
    for index in range(1, 7):
        publish('image', index)
        if index <= 4:
            publish('keypoints', index)
        # DDS keeps the order of one topic only.
        one.spin_until(lambda: len(queue) >= sent)
    go.set()
    seen = stub_tracker.made[0].seen
    one.spin_until(lambda: len(seen) == 2)
    # 5 and 6 still wait for their keypoints.
    for index in (5, 6):
        publish('keypoints', index)
        one.spin_until(lambda index=index: len(seen) == index - 2)
    assert [stamp for stamp, _ in seen] == [small_camera.stamp(index) for index in (0, 4, 5, 6)]
    assert all(keypoints is not None for _, keypoints in seen)
    one.spin_until(lambda: len(one.handled) == 1 + 7 + 7)
    counts = one.session.state.counts
    assert counts == {'received': 7, 'tracked': 4, 'dropped': 3}
    assert sum(h.source == 'image' for h in one.handled) == 7
    told = [text for h in one.handled for text in h.faults]
    assert len(told) == 3
    assert all('newer ones came before its turn' in text for text in told)


def test_diagnostics(running, small_camera):
    level, message, values = running.diagnosis()
    assert (level, message) == (1, 'waits for a calibrated camera_info')
    assert values['lifecycle'] == 'active'
    # Until an image names the camera frame, the topic identifies the camera.
    assert running.diagnostics[-1].status[0].hardware_id == '/image'
    running.send('camera_info', small_camera.info())
    running.send('image', small_camera.image(0))
    # Published at once when the status changes.
    running.spin_until(lambda: running.diagnostics[-1].status[0].message == 'tracking, 2 modes')
    _, _, values = running.diagnosis()
    assert running.diagnostics[-1].status[0].name == 'filter_node: track'
    assert running.diagnostics[-1].status[0].hardware_id == 'lens'
    assert values['status'] == 'tracking'
    assert np.isclose(float(values['entropy of the weights, nats']), 0.562, atol=1e-3)
    assert values['misfit'] == '0.125'
    assert values['evaluations of the likelihood'] == '7'
    assert {'latency, mean, ms', 'images tracked a second', 'last fault'} <= values.keys()


# The executable.


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_ends_cleanly(number, subject_file, executable):
    file = f'subject_file:={subject_file}'
    node = executable('filter_node', '-p', file, '--params-file', str(CONFIG))
    lines = node.stop_at('images from /image', number)
    assert 'images from /image' in lines[-1]


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (('-p', 'max_hypotheses:=99'), 'out of range'),
        (('-p', 'image_transport:=guess'), "saw 'guess'"),
    ],
)
def test_wrong_arguments_are_one_line(arguments, message, ended):
    code, output, errors = ended('filter_node', '--ros-args', *arguments)
    line = only_line(code, output + errors)
    assert line.startswith('filter_node: ')
    assert message in line


def test_robots_are_told_that_no_image_is_answered(world, small_camera):
    from builtin_interfaces.msg import Time
    from hmt_msgs.msg import KeepOut
    from hmt_msgs.srv import ForecastPose

    one = world(stale_time=0.3)
    told = []
    one.listen(KeepOut, 'keep_out', told)
    one.start()
    one.spin_until(lambda: told and told[-1].state == KeepOut.STATE_STALE, 'a stale message')
    assert len(told[-1].radii) == 0
    one.send('camera_info', small_camera.info())
    one.send('image', small_camera.image(0))
    one.spin_until(lambda: any(x.state == KeepOut.STATE_TRACKING for x in told), 'the image')
    count = len(told)
    one.spin_until(lambda: len(told) > count + 3, 'more of them')
    assert {message.state for message in told[count + 1 :]} == {KeepOut.STATE_STALE}
    # It grows.
    assert told[-1].unseen > told[-2].unseen >= 0.3
    assert min(told[-1].radii) > min(told[-2].radii)
    # A forecast for the current time.
    answer = one.call(ForecastPose, 'forecast_pose', stamp=Time())
    assert not answer.success
    assert 'wanted a time from then to 10 s later' in answer.message
    seconds, nanoseconds = divmod(small_camera.stamp(1), 10**9)
    later = Time(sec=seconds, nanosec=nanoseconds)
    answer = one.call(ForecastPose, 'forecast_pose', stamp=later)
    assert answer.success
    assert answer.mixture.header.stamp == later
    assert answer.mixture.kind == answer.mixture.FORECAST
    assert one.change_state('deactivate')
    count = len(told)
    time.sleep(0.2)
    one.executor.spin_once(timeout_sec=0.1)
    assert len(told) <= count + 1
    assert one.change_state('activate')


@pytest.mark.parametrize('resets', [False, True])
def test_a_clock_that_goes_back_is_an_error_for_a_while(
    running, small_camera, stub_tracker, resets, monkeypatch
):
    assert running.set(reset_on_time_jump=resets) == (True, '')
    running.send('camera_info', small_camera.info())
    for index in (6000, 6001):
        assert faults(running.send('image', small_camera.image(index))) == []
    for index in range(4):
        assert faults(running.send('image', small_camera.image(index))) == []
    assert len(stub_tracker.made) == 2
    level, text, _ = running.diagnosis()
    assert (level, text[:30]) == (2, 'the clock went back by 600 s: ')
    assert any('the clock went back by 600 s' in warning for warning in running.warnings())
    monkeypatch.setattr(session_node, 'TIME_JUMP_ALARM_TIME', 0.0)
    assert not running.diagnosis()[1].startswith('the clock')
