"""Markers of the modes of a mixture."""

from typing import Any

import numpy as np
import pytest

from msg_tools import MessageError
from msg_tools.messages.markers import skeleton_markers

ADD, DELETE, LINE_LIST, SPHERE_LIST = 0, 2, 5, 7
NAMES = ['pelvis', 'neck', 'head']
EDGES = [('pelvis', 'neck'), ('neck', 'head')]
POSITIONS = np.arange(27, dtype=float).reshape(3, 3, 3)
WEIGHTS = [0.2, 0.5, 0.3]


def markers(messages, **changes):
    arguments: dict[str, Any] = {
        'joint_positions': POSITIONS,
        'joint_names': NAMES,
        'edges': EDGES,
        'weights': WEIGHTS,
        'stamp_ns': 7,
        'frame_id': 'camera',
        'ranks': 5,
    }
    return skeleton_markers(messages, **{**arguments, **changes}).markers


def test_every_rank_is_spoken_of(messages):
    found = [(m.ns, m.id, m.action) for m in markers(messages)]
    assert found == [
        (f'mode_{rank}', key, ADD if rank < 3 else DELETE) for rank in range(5) for key in (0, 1)
    ]
    # Fewer modes the next time: the same markers are named, some to be deleted.
    later = markers(messages, joint_positions=POSITIONS[:1], weights=[1.0])
    assert [(m.ns, m.id) for m in later] == [(ns, key) for ns, key, _ in found]
    assert [m.action for m in later] == [ADD] * 2 + [DELETE] * 8
    assert all(m.header.frame_id == 'camera' and m.header.stamp.nanosec == 7 for m in later)
    assert all(m.pose.orientation.w == 1.0 for m in later)


def test_heaviest_first_and_least_transparent(messages):
    found = markers(messages)
    for rank, mode in enumerate([1, 2, 0]):
        bones, joints = found[2 * rank : 2 * rank + 2]
        assert (bones.type, joints.type) == (LINE_LIST, SPHERE_LIST)
        np.testing.assert_array_equal([(p.x, p.y, p.z) for p in joints.points], POSITIONS[mode])
        np.testing.assert_array_equal(
            [(p.x, p.y, p.z) for p in bones.points], POSITIONS[mode][[0, 1, 1, 2]]
        )
        assert bones.scale.x > 0
        assert joints.scale.x == joints.scale.y == joints.scale.z > bones.scale.x
    alphas = [found[2 * rank].color.a for rank in range(3)]
    assert alphas[0] == 1.0
    np.testing.assert_allclose(np.diff(alphas), [-0.88 * 0.4, -0.88 * 0.2], atol=1e-12)
    assert found[0].color.r > found[0].color.b
    assert found[2].color.r < found[2].color.b


def test_defects(messages):
    with pytest.raises(MessageError, match=r'shape \(3, 3, 3\), wanted \(2, 3, 3\)'):
        markers(messages, weights=[0.5, 0.5])
    with pytest.raises(MessageError, match="has the unknown joint 'tail'"):
        markers(messages, edges=[('pelvis', 'tail')])
