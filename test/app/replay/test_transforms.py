"""replay of bags with /tf: gravity and the height of the camera from the bag itself."""

import numpy as np
import pytest

from hmt_learning.motion.viewpoint import Viewpoint
from hmt_ros.app.replay.command import main
from hmt_ros.app.replay.inputs import recorded_input, upright_frame
from hmt_ros.sessions.camera_frames import UP_SIGMA
from msg_tools import BagReader, RosbagsMessages
from msg_tools.bags.bag_metadata import absolute_name
from msg_tools.messages.ground import ground_of
from msg_tools.messages.headers import time_ns
from msg_tools.messages.states import transforms_message
from test.app.replay.test_command import PERSON, read, recorded, write

VIEW = Viewpoint(distance=4.0, height=1.25, pitch=0.15)
FRAME = ['--set', 'gravity_frame=world', '--set', 'floor_in_gravity_frame=true']
ESTIMATES = ('pose_mixture', 'likelihood_mixture', 'human_joint_states', 'ground')
SMALL = ['--set', 'max_hypotheses=2', '--set', 'evaluation_budget=100']


def camera_place(stamp, parent, child):
    return transforms_message(
        RosbagsMessages(),
        [parent],
        [child],
        VIEW.rotation.T[None],
        VIEW.to_world(np.zeros(3))[None],
        stamp,
    )


def with_transforms(entries):
    """The entries with transforms of a robot at the origin, from before to after the images."""
    images = [x for x in entries if x[0] == 'image/compressed']
    frame = str(images[0][2].header.frame_id)
    times = [images[0][1], *(time + 1_000_000 for _, time, _ in images)]
    robot = [
        transforms_message(
            RosbagsMessages(), ['world'], ['robot'], np.eye(3)[None], np.zeros((1, 3)), stamp
        )
        for stamp in times
    ]
    extra = [('/tf_static', times[0], camera_place(0, 'robot', frame))]
    extra += [('/tf', time, message) for time, message in zip(times, robot, strict=True)]
    return sorted([*entries, *extra], key=lambda entry: entry[1])


@pytest.fixture(scope='module')
def entries():
    return recorded()


@pytest.fixture(scope='module')
def moving(tmp_path_factory, entries):
    return write(tmp_path_factory.mktemp('moving') / 'bag', with_transforms(entries))


@pytest.fixture(scope='module')
def replayed(moving, tmp_path_factory):
    out = tmp_path_factory.mktemp('replayed') / 'out'
    arguments = [str(moving), '-o', str(out), *PERSON, *SMALL, *FRAME, '--with-images']
    assert main([*arguments, '--no-smoother', '--quiet']) == 0
    return out


def data(folder, topic):
    messages = read(folder)[absolute_name(topic)]
    return [(stored.log_time_ns, bytes(stored.data)) for stored in messages]


def test_ground_is_that_of_the_frame(replayed):
    found = read(replayed)
    grounds = [ground_of(stored.message) for stored in found['/ground']]
    assert [x.stamp_ns for x in grounds] == [
        time_ns(stored.message.header.stamp) for stored in found['/pose_mixture']
    ]
    for ground in grounds:
        # Lines in the image refine it within the deviation of a sensor.
        np.testing.assert_allclose(ground.up, VIEW.rotation[:, 2], atol=3e-3)
        assert ground.height == pytest.approx(1.25, abs=0.05)


def test_same_numbers_as_with_parameters_of_the_same_gravity(replayed, moving, tmp_path):
    down = [float(x) for x in -VIEW.rotation[:, 2]]
    sure = f'gravity_sigma={np.degrees(UP_SIGMA)}'
    settings = [f'gravity={down}', sure, 'camera_height=1.25', 'fixed_frame=']
    settings = [x for one in settings for x in ('--set', one)]
    arguments = [str(moving), '-o', str(tmp_path / 'out'), *PERSON, *SMALL, *settings]
    assert main([*arguments, '--no-smoother', '--quiet']) == 0
    other, one = read(tmp_path / 'out'), read(replayed)
    # The transforms are not used, and not copied.
    assert '/tf_static' not in other
    for first, second in zip(one['/pose_mixture'], other['/pose_mixture'], strict=True):
        pairs = zip(first.message.components, second.message.components, strict=True)
        for a, b in pairs:
            np.testing.assert_allclose(a.mean, b.mean, atol=1e-5)
            assert a.weight == pytest.approx(b.weight, abs=1e-4)
    for first, second in zip(one['/ground'], other['/ground'], strict=True):
        np.testing.assert_allclose(first.message.plane, second.message.plane, atol=1e-6)


def test_a_frame_with_z_up_is_used_by_itself(moving, entries, tmp_path, capsys):
    told = ['--set', 'gravity_frame=world', '--set', 'fixed_frame=world']
    for name, settings in (('by_itself', []), ('told', told)):
        arguments = [str(moving), '-o', str(tmp_path / name), *PERSON, *SMALL, *settings]
        assert main([*arguments, '--no-smoother']) == 0
    for topic in ESTIMATES:
        assert data(tmp_path / 'by_itself', topic) == data(tmp_path / 'told', topic)
    assert capsys.readouterr().err.count('gravity and the motion of the camera: from world') == 2
    ground = ground_of(read(tmp_path / 'by_itself')['/ground'][0].message)
    np.testing.assert_allclose(ground.up, VIEW.rotation[:, 2], atol=3e-3)
    # A given direction has priority.
    arguments = [str(moving), '-o', str(tmp_path / 'given'), *PERSON, *SMALL]
    assert main([*arguments, '--set', 'gravity=[0, 1, 0]', '--no-smoother', '--quiet']) == 0
    ground = ground_of(read(tmp_path / 'given')['/ground'][0].message)
    np.testing.assert_allclose(ground.up, [0.0, -1.0, 0.0], atol=np.sin(np.radians(2.01)))


@pytest.mark.parametrize(
    ('links', 'found'),
    [
        ([('map', 'odom'), ('odom', 'base_link'), ('base_link', 'camera')], 'odom'),
        ([('map', 'base_link'), ('/base_link', '/camera')], 'map'),
        ([('camera', 'odom')], ''),
        ([('torso', 'camera'), ('odom', 'wheel')], ''),
        ([('a', 'camera'), ('b', 'a'), ('a', 'b')], ''),
    ],
)
def test_the_nearest_upright_frame_above_the_camera(entries, tmp_path, links, found):
    extra = [
        ('/tf', 10 + i, transforms_message(
            RosbagsMessages(), [parent], [child], np.eye(3)[None], np.zeros((1, 3)), i
        ))
        for i, (parent, child) in enumerate(links)
    ]  # fmt: skip
    for topic, _, message in entries:
        if topic == 'camera_info':
            message.header.frame_id = 'camera'
    path = write(tmp_path / 'bag', sorted([*entries, *extra], key=lambda entry: entry[1]))
    with BagReader(path) as bag:
        assert upright_frame(bag, recorded_input(bag)) == found


def test_new_bag_has_what_was_used(replayed, moving, tmp_path):
    """A replay of the new bag gives the same bytes."""
    found, given = read(replayed), read(moving)
    assert data(replayed, '/tf_static') == data(moving, '/tf_static')
    links = {message for _, message in data(replayed, '/tf')}
    assert {message for _, message in data(moving, '/tf')} < links
    assert len(found['/tf']) == len(given['/tf']) + len(found['/ground'])
    out = tmp_path / 'again'
    arguments = [str(replayed), '-o', str(out), *PERSON, *SMALL, *FRAME, '--no-smoother']
    assert main([*arguments, '--quiet']) == 0
    for topic in ESTIMATES:
        assert data(out, topic) == data(replayed, topic)


def test_fixed_frame_of_a_camera_that_stands_still(replayed, moving, tmp_path):
    """A camera at rest in the fixed frame gives the same results as without a fixed frame."""
    out = tmp_path / 'out'
    arguments = [str(moving), '-o', str(out), *PERSON, *SMALL, *FRAME, '--set', 'fixed_frame=world']
    assert main([*arguments, '--no-smoother', '--quiet']) == 0
    for topic in ESTIMATES[:-1]:
        assert data(out, topic) == data(replayed, topic)
    assert data(out, '/tf_static') == data(moving, '/tf_static')
