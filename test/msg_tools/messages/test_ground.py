"""hmt_msgs/Ground and its markers."""

import numpy as np
import pytest

from msg_tools import MessageError, RosbagsMessages
from msg_tools.messages.cdr import deserialise, serialise
from msg_tools.messages.ground import GROUND, GroundState, ground_message, ground_of
from msg_tools.messages.markers import ground_markers, removed_ground

STAMP = 1_700_000_000_123_456_789
MESSAGES = RosbagsMessages()
UP = np.array([0.1, -0.9, -0.2]) / np.linalg.norm([0.1, -0.9, -0.2])
JOINTS = ('pelvis', 'left_ankle', 'left_toe', 'right_ankle')


def state(**values):
    known = {
        'up': UP, 'up_sigma': 0.05, 'height': 1.25, 'height_sigma': 0.1,
        'contacts': {'left_foot': 0.9, 'right_foot': 0.01},
    }  # fmt: skip
    return GroundState(STAMP, 'lens', **{**known, **values})


def carried(content):
    return deserialise(serialise(ground_message(MESSAGES, content)), GROUND)


def test_content_survives_the_message():
    found = ground_of(carried(state()))
    assert (found.stamp_ns, found.frame_id) == (STAMP, 'lens')
    np.testing.assert_array_equal(found.up, UP)
    np.testing.assert_array_equal(found.plane, [*UP, 1.25])
    assert (found.up_sigma, found.height, found.height_sigma) == (0.05, 1.25, 0.1)
    assert found.contacts == {'left_foot': 0.9, 'right_foot': 0.01}
    # The point below the camera lies on the floor.
    assert np.isclose(found.plane @ [*(-1.25 * UP), 1.0], 0.0)


def test_what_is_unknown_survives_too():
    message = carried(state(height=None, height_sigma=np.nan, up_sigma=np.inf, contacts={}))
    assert np.isnan(message.plane).all()
    assert np.isnan(message.height)
    found = ground_of(message)
    assert found.height is None
    assert found.plane is None
    assert found.contacts == {}
    assert found.up_sigma == np.inf


@pytest.mark.parametrize(
    ('name', 'value', 'why'),
    [
        ('plane', np.zeros(4), 'ground: plane is'),
        ('plane', np.full(4, np.nan), 'ground: plane is'),
        ('height', np.nan, 'ground: plane is'),
        ('height', np.inf, 'ground: height is inf'),
        ('up_sigma', -1.0, 'ground: up_sigma is -1.0, wanted 0 or more'),
        ('height_sigma', -1.0, 'ground: height_sigma is -1.0'),
        ('contact_names', ['left_foot'], 'contact_probabilities has 2 values, wanted 1'),
        ('contact_names', ['foot', 'foot'], "ground: contacts has the name 'foot' twice"),
        ('contact_probabilities', np.array([0.5, 1.5]), 'contact of right_foot is 1.5'),
        ('contact_probabilities', np.array([np.nan, 0.5]), 'contact of left_foot is nan'),
    ],
)
def test_contradictions_are_refused(name, value, why):
    message = ground_message(MESSAGES, state())
    setattr(message, name, value)
    with pytest.raises(MessageError, match=why):
        ground_of(message)


def place_of(marker):
    position, turn = marker.pose.position, marker.pose.orientation
    q = np.array([turn.x, turn.y, turn.z, turn.w])
    assert np.isclose(np.linalg.norm(q), 1.0)
    x, y, z, w = q
    # The third column of its rotation.
    axis = np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)])
    return np.array([position.x, position.y, position.z]), axis


@pytest.mark.parametrize('up', [UP, [0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
def test_floor_lies_under_the_person(up):
    joints = np.random.default_rng(0).normal(loc=(0.0, 0.0, 4.0), size=(4, 3))
    content = state(up=np.array(up))
    floor, _ = ground_markers(MESSAGES, content, joints, JOINTS)
    assert (floor.ns, floor.type, floor.action) == ('floor', 1, 0)
    place, axis = place_of(floor)
    np.testing.assert_allclose(axis, content.up, atol=1e-9)
    # The top of the square is the floor.
    top = place + 0.5 * floor.scale.z * content.up
    assert np.isclose(content.plane @ [*top, 1.0], 0.0)
    across = top - joints.mean(0)
    np.testing.assert_allclose(across - (across @ content.up) * content.up, 0.0, atol=1e-9)
    assert 0 < floor.color.a < 0.5


def test_what_is_not_known_is_deleted():
    joints = np.zeros((4, 3))
    unknown = state(height=None, contacts={'left_foot': 0.0})
    found = ground_markers(MESSAGES, unknown, joints, JOINTS)
    removed = removed_ground(MESSAGES, STAMP, 'lens')
    for markers in (found, removed):
        assert [(m.ns, m.id, m.action) for m in markers] == [('floor', 0, 2), ('contacts', 0, 2)]
        assert all(m.header.frame_id == 'lens' for m in markers)
    serialise(MESSAGES.create('visualization_msgs/msg/MarkerArray', markers=[*found, *removed]))
