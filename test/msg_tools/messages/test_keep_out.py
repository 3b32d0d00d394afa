"""hmt_msgs/KeepOut and the messages for planners and viewers made from it."""

import numpy as np
import pytest

from msg_tools import MessageError, RosbagsMessages
from msg_tools.messages.cdr import deserialise, serialise
from msg_tools.messages.keep_out import (
    KEEP_OUT,
    KeepOut,
    KeepOutState,
    collision_shapes,
    keep_out_markers,
    keep_out_message,
    keep_out_of,
)

STAMP = 1_700_000_000_123_456_789
MESSAGES = RosbagsMessages()
STARTS = np.array([[0.0, 0.0, 3.0], [1.0, 0.5, 2.0], [0.0, 0.0, 1.0]])
ENDS = np.array([[0.0, 0.4, 3.0], [1.0, 0.5, 2.0], [0.3, -0.1, 0.2]])


def content(**values):
    known = {
        'state': KeepOutState.LOST, 'starts': STARTS, 'ends': ENDS,
        'radii': np.array([0.2, 0.3, 0.1]), 'track_id': 7, 'existence_probability': 0.75,
        'unseen': 0.25, 'probability': 0.99,
    }  # fmt: skip
    return KeepOut(STAMP, 'lens', **{**known, **values})


def carried(one):
    return deserialise(serialise(keep_out_message(MESSAGES, one)), KEEP_OUT)


def test_content_survives_the_message():
    found, wanted = keep_out_of(carried(content())), content()
    assert (found.stamp_ns, found.frame_id, found.state) == (STAMP, 'lens', KeepOutState.LOST)
    for name in ('starts', 'ends', 'radii'):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    assert (found.track_id, found.existence_probability) == (7, 0.75)
    assert (found.unseen, found.probability) == (0.25, 0.99)


def test_of_nobody_there_is_no_capsule():
    none = {'starts': np.empty((0, 3)), 'ends': np.empty((0, 3)), 'radii': np.empty(0)}
    found = keep_out_of(carried(content(state=KeepOutState.NOBODY, unseen=np.nan, **none)))
    assert len(found.radii) == 0
    assert np.isnan(found.unseen)
    with pytest.raises(MessageError, match='3 capsules of nobody, wanted none'):
        content(state=KeepOutState.NOBODY)


@pytest.mark.parametrize(
    ('name', 'value', 'why'),
    [
        ('radii', np.array([0.1, -0.1, 0.1]), 'a radius is -0.1, wanted 0 or more'),
        ('radii', np.array([0.1, np.nan, 0.1]), 'radii'),
        ('starts', np.zeros((2, 3)), 'starts'),
        ('unseen', -1.0, 'unseen is -1.0 s, wanted 0 or more, or NaN'),
    ],
)
def test_bad_values_are_refused(name, value, why):
    with pytest.raises(MessageError, match=why):
        content(**{name: value})


def test_bad_messages_are_refused():
    message = carried(content())
    message.state = 9
    with pytest.raises(MessageError, match='keep out: state 9 is unknown'):
        keep_out_of(message)
    message = carried(content())
    message.starts = message.starts[:-1]
    with pytest.raises(MessageError, match='starts has 8 values, wanted 9'):
        keep_out_of(message)


def axis(orientation):
    """The z axis rotated by a quaternion."""
    x, y, z, w = (getattr(orientation, name) for name in 'xyzw')
    assert np.isclose(np.linalg.norm([x, y, z, w]), 1.0)
    return np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])


def test_planners_get_cylinders_and_spheres():
    solids, poses = collision_shapes(MESSAGES, content())
    assert [one.type for one in solids] == [2, 2, 3, 2, 2, 2, 3]
    np.testing.assert_allclose(solids[2].dimensions, [0.4, 0.2])
    np.testing.assert_allclose(axis(poses[2].orientation), [0.0, 1.0, 0.0], atol=1e-12)
    way = ENDS[2] - STARTS[2]
    np.testing.assert_allclose(axis(poses[6].orientation), way / np.linalg.norm(way), atol=1e-12)
    middle = poses[6].position
    np.testing.assert_allclose([middle.x, middle.y, middle.z], 0.5 * (STARTS[2] + ENDS[2]))
    down = content(starts=np.zeros((1, 3)), ends=np.array([[0.0, 0.0, -1.0]]), radii=np.ones(1))
    np.testing.assert_allclose(
        axis(collision_shapes(MESSAGES, down)[1][2].orientation), [0.0, 0.0, -1.0], atol=1e-12
    )


def test_viewers_forget_the_capsules_before():
    markers = keep_out_markers(MESSAGES, content()).markers
    assert markers[0].action == 3
    assert len(markers) == 8
    assert len({marker.id for marker in markers[1:]}) == 7
    assert markers[3].scale.z == pytest.approx(0.4)
