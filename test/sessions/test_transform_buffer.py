"""Transforms over time, compared with scipy's rotations; and invalid messages."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from hmt_ros.sessions import transform_buffer
from hmt_ros.sessions.transform_buffer import TransformBuffer, TransformError
from msg_tools import RosbagsMessages
from msg_tools.messages.states import transforms_message

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def message(parent, child, rotation=None, translation=(0.0, 0.0, 0.0), stamp=START):
    matrix = np.eye(3) if rotation is None else rotation.as_matrix()
    return transforms_message(
        RosbagsMessages(), [parent], [child], matrix[None], np.array([translation]), stamp
    )


@pytest.fixture
def buffer():
    return TransformBuffer()


def random_places(count, seed=0):
    rng = np.random.default_rng(seed)
    return Rotation.random(count, random_state=seed), rng.normal(size=(count, 3))


def test_transforms_are_joined_along_the_tree(buffer):
    """The tree is map - odom - base - camera, with an arm as a branch."""
    rotations, places = random_places(4)
    parents = {'odom': 'map', 'base': 'odom', 'camera': 'base', 'hand': 'base'}
    matrices = {}
    for (child, parent), r, t in zip(parents.items(), rotations, places, strict=True):
        assert buffer.put(message(parent, child, r, t), static=child != 'base') == []
        matrices[child] = np.eye(4)
        matrices[child][:3, :3], matrices[child][:3, 3] = r.as_matrix(), t
    in_map = {'map': np.eye(4), 'odom': matrices['odom']}
    in_map['base'] = in_map['odom'] @ matrices['base']
    in_map['camera'] = in_map['base'] @ matrices['camera']
    in_map['hand'] = in_map['base'] @ matrices['hand']
    assert buffer.frames() == sorted(in_map)
    for target, above in in_map.items():
        for source, below in in_map.items():
            wanted = np.linalg.inv(above) @ below
            found = buffer.lookup(target, f'/{source}', START)
            np.testing.assert_allclose(found.rotation, wanted[:3, :3], atol=1e-12)
            np.testing.assert_allclose(found.translation, wanted[:3, 3], atol=1e-12)


@pytest.mark.parametrize('angle', [0.01, 1.0, 3.0])
def test_between_stamps_is_the_shortest_arc(buffer, angle):
    first = Rotation.from_euler('xyz', [0.3, -0.2, 2.0])
    last = first * Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8]))
    buffer.put(message('world', 'camera', first, (1.0, 2.0, 3.0)), static=False)
    other = message('world', 'camera', last, (2.0, 0.0, 3.0), START + SECOND)
    # The same rotation with inverted signs.
    q = other.transforms[0].transform.rotation
    q.x, q.y, q.z, q.w = -q.x, -q.y, -q.z, -q.w
    buffer.put(other, static=False)
    between = Slerp([0.0, 1.0], Rotation.concatenate([first, last]))
    for share in (0.0, 0.25, 0.9, 1.0):
        found = buffer.lookup('world', 'camera', START + round(share * SECOND))
        np.testing.assert_allclose(found.rotation, between(share).as_matrix(), atol=1e-6)
        np.testing.assert_allclose(found.translation, [1 + share, 2 - 2 * share, 3], atol=1e-12)
    for stamp in (START - 1, START + SECOND + 1):
        with pytest.raises(TransformError, match=f"'camera' has transforms of .* wanted {stamp}"):
            buffer.lookup('world', 'camera', stamp)


def test_order_of_arrival_does_not_matter(buffer):
    for k in (3, 0, 2, 1, 2):
        buffer.put(message('world', 'camera', None, (k, 0, 0), START + k * SECOND), static=False)
    found = buffer.lookup('world', 'camera', START + SECOND + SECOND // 2)
    np.testing.assert_allclose(found.translation, [1.5, 0, 0])
    assert buffer.has_later(START, 2.9 * SECOND)
    assert not buffer.has_later(START, 3 * SECOND)


def test_a_frame_that_changes_its_parent(buffer):
    buffer.put(message('left', 'box', None, (1, 0, 0), START), static=False)
    buffer.put(message('right', 'box', None, (2, 0, 0), START + SECOND), static=False)
    # Between the two messages it is at its last place, as in tf2.
    found = buffer.lookup('left', 'box', START + SECOND // 2)
    np.testing.assert_allclose(found.translation, [1, 0, 0])
    np.testing.assert_allclose(buffer.lookup('right', 'box', START + SECOND).translation, [2, 0, 0])


def test_memory_is_bounded(buffer, monkeypatch):
    monkeypatch.setattr(transform_buffer, 'MAX_STAMPS', 50)
    monkeypatch.setattr(transform_buffer, 'MAX_FRAMES', 3)

    def kept(frame):
        return len(buffer._frames[frame].places)

    for k in range(200):
        buffer.put(message('world', 'camera', stamp=START + k * SECOND // 10), static=False)
    assert kept('camera') == 50
    for k in range(200):
        buffer.put(message('world', 'slow', stamp=START + k * SECOND), static=False)
    assert kept('slow') == 11  # ten seconds
    assert buffer.put(message('world', 'third'), static=True) == []
    (fault,) = buffer.put(message('world', 'fourth'), static=True)
    assert fault == "transform from 'fourth' to 'world': there are 3 frames already"


def test_time_that_jumps_back(buffer):
    for k in range(5):
        buffer.put(message('world', 'camera', None, (k, 0, 0), START + k * SECOND), static=False)
    buffer.forget_after(START + SECOND)
    assert not buffer.has_later(START, SECOND)
    with pytest.raises(TransformError):
        buffer.lookup('world', 'camera', START + 2 * SECOND)
    # A restarted bag is detected without a signal.
    for k in (100, 99):
        buffer.put(message('world', 'camera', None, (9, 0, 0), START - k * SECOND), static=False)
    assert buffer.lookup('world', 'camera', START - 100 * SECOND).translation[0] == 9
    buffer.forget_after(0)
    assert buffer.frames() == []


@pytest.mark.parametrize('ahead', [3600, -3600])
def test_a_stray_stamp_changes_nothing(buffer, ahead):
    for k in range(5):
        buffer.put(message('world', 'camera', None, (k, 0, 0), START + k * SECOND), static=False)
        stray = START + (k + ahead) * SECOND
        buffer.put(message('world', 'camera', None, (9, 0, 0), stray), static=False)
        buffer.put(message('world', f'stray {k}', None, (9, 0, 0), stray), static=False)
    found = buffer.lookup('world', 'camera', START + SECOND // 2)
    np.testing.assert_allclose(found.translation, [0.5, 0, 0])
    assert not buffer.has_later(START, 5 * SECOND)


def spoilt(**values):
    made = message('world', 'camera')
    for name, value in values.items():
        transform = made.transforms[0].transform
        if name == 'x':
            transform.translation.x = value
        elif name == 'rotation':
            q = transform.rotation
            q.x, q.y, q.z, q.w = value
    return made


@pytest.mark.parametrize(
    ('bad', 'why'),
    [
        (spoilt(x=np.nan), 'its numbers are not finite'),
        (spoilt(x=-np.inf), 'its numbers are not finite'),
        (spoilt(rotation=(0.0, 0.0, 0.0, np.nan)), 'its numbers are not finite'),
        (spoilt(rotation=(0.0, 0.0, 0.0, 0.0)), 'its quaternion has length 0, wanted 1'),
        (spoilt(rotation=(0.0, 0.0, 0.0, 2.0)), 'its quaternion has length 2, wanted 1'),
        (spoilt(rotation=(1e300, 0.0, 0.0, 1.0)), 'its quaternion has length 1e+300, wanted 1'),
        (message('', 'camera'), 'a frame has no name'),
        (message('world', '/'), 'a frame has no name'),
        (message('camera', 'camera'), 'a frame can not be its own parent'),
    ],
)
@pytest.mark.parametrize('static', [False, True])
def test_bad_transforms_are_left_out(buffer, bad, why, static):
    bad.transforms += message('world', 'table').transforms
    (fault,) = buffer.put(bad, static=static)
    assert fault.startswith('transform from ')
    assert fault.endswith(why)
    assert buffer.frames() == ['table', 'world']


def test_frames_that_are_not_connected(buffer):
    with pytest.raises(TransformError, match="there is no frame 'world'; there are: none"):
        buffer.lookup('camera', 'world', START)
    buffer.put(message('map', 'base'), static=True)
    buffer.put(message('lens', 'camera'), static=True)
    with pytest.raises(
        TransformError, match="no frame 'world'; there are: base, camera, lens, map"
    ):
        buffer.lookup('camera', 'world', START)
    with pytest.raises(TransformError, match="'map' and 'camera' are not connected; there are"):
        buffer.lookup('camera', 'map', START)
    for k in range(20):
        buffer.put(message('map', f'wheel\n{k:02d}'), static=True)
    with pytest.raises(TransformError, match=r'wheel 07 and 12 more$'):
        buffer.lookup('camera', 'world', START)


def test_frames_in_a_loop(buffer):
    for parent, child in (('a', 'b'), ('b', 'c'), ('c', 'a')):
        buffer.put(message(parent, child), static=True)
    # Frames in the loop are reachable; others are not, and the search ends.
    buffer.lookup('a', 'c', START)
    buffer.put(message('world', 'd'), static=True)
    with pytest.raises(TransformError, match='the frames c, b, a, c form a loop'):
        buffer.lookup('c', 'world', START)
