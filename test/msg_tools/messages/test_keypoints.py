"""Keypoints2D and Keypoints3D to arrays and back, and refused messages."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from msg_tools import MessageError
from msg_tools.messages.detections import NO_KEYPOINTS
from msg_tools.messages.keypoints import (
    keypoints_message,
    keypoints_of,
    positions_message,
    positions_of,
)


def message(messages, **changes):
    fields: dict[str, Any] = {
        'names': ['neck', 'left_elbow', 'head'],
        'u': [10.0, np.nan, 30.5],
        'v': [20.0, np.nan, 40.5],
        'covariance': np.tile([4.0, 1.0, 1.0, 9.0], 3),
        'confidence': [1.0, 0.0, 0.5],
    }
    return messages.create('hmt_msgs/msg/Keypoints2D', **{**fields, **changes})


def test_fields_become_arrays(messages):
    content = keypoints_of(message(messages), 3.0)
    assert content.names == ('neck', 'left_elbow', 'head')
    np.testing.assert_array_equal(content.pixels, [[10, 20], [np.nan, np.nan], [30.5, 40.5]])
    np.testing.assert_array_equal(content.seen, [True, False, True])
    np.testing.assert_array_equal(content.covariances[2], [[4, 1], [1, 9]])
    np.testing.assert_array_equal(content.confidences, [1, 0, 0.5])
    again = keypoints_of(keypoints_message(messages, content, 7, 'camera'), 1.0)
    np.testing.assert_array_equal(again.pixels, content.pixels)
    np.testing.assert_array_equal(again.covariances, content.covariances)


def test_what_was_not_seen_has_no_place_and_no_confidence(messages):
    changed = message(
        messages,
        names=['confidence', 'nan', 'corner', 'border', 'seen', 'anything'],
        u=[10.0, np.nan, 0.0, 0.0, 5.0, np.inf],
        v=[20.0, np.nan, 0.0, 7.0, 6.0, np.nan],
        covariance=[np.nan] * 12 + [4.0, 0.0, 0.0, 4.0] * 2 + [-1.0] * 4,
        confidence=[0.0, np.nan, 1.0, 0.5, 1.0, 0.0],
    )
    content = keypoints_of(changed, 3.0)
    np.testing.assert_array_equal(content.seen, [False, False, False, True, True, False])
    np.testing.assert_array_equal(content.confidences, [0, 0, 0, 0.5, 1, 0])
    np.testing.assert_array_equal(content.covariances[[0, 1, 2, 5]], np.tile(np.eye(2), (4, 1, 1)))


def test_covariances_of_some_may_be_unknown(messages):
    given = message(messages, covariance=[np.nan] * 8 + [4.0, 1.0, 1.0, 9.0])
    content = keypoints_of(given)
    assert np.isnan(content.covariances[0]).all()
    np.testing.assert_array_equal(content.covariances[2], [[4, 1], [1, 9]])
    again = keypoints_of(keypoints_message(messages, content, 7, 'camera'))
    np.testing.assert_array_equal(again.covariances, content.covariances)
    # If all covariances are unknown, the message has none.
    nothing = replace(content, covariances=np.full((3, 2, 2), np.nan))
    assert len(keypoints_message(messages, nothing, 7, 'camera').covariance) == 0
    assumed = keypoints_of(given, 3.0)
    np.testing.assert_array_equal(assumed.covariances[[0, 2]], [9 * np.eye(2), [[4, 1], [1, 9]]])


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'names': []}, r'keypoints: u has 3 values, wanted 0'),
        ({'names': ['neck', 'neck', 'head']}, r"keypoints has the name 'neck' twice"),
        ({'names': ['x'] * 10_001}, r'keypoints has 10001 names, the limit is 10000'),
        ({'u': [1.0, 2.0]}, r'keypoints: u has 2 values, wanted 3'),
        ({'v': [1.0] * 4}, r'keypoints: v has 4 values, wanted 3'),
        ({'covariance': [1.0] * 11}, r'keypoints: covariance has 11 values, wanted 12'),
        ({'confidence': [1.0]}, r'keypoints: confidence has 1 values, wanted 3'),
        ({'confidence': [-0.1, 1.0, 1.0]}, r'neck has confidence -0.1, wanted 0 to 1'),
        ({'confidence': [1.0, 1.0, 1.1]}, r'head has confidence 1.1'),
        ({'confidence': [np.nan, 1.0, 1.0]}, r'neck has confidence nan'),
        (
            {'u': [1.0, np.nan, np.nan]},
            r'keypoint head lies at \(nan, 40.5\), wanted numbers within',
        ),
        ({'u': [1.0, np.nan, np.inf]}, r'keypoint head lies at \(inf, 40.5\)'),
        (
            {'u': [1e300, np.nan, 1.0]},
            r'keypoint neck lies at \(1e\+300, 20.0\), wanted .* 1e\+06 px',
        ),
        ({'covariance': [0.0] * 12}, r'covariance of keypoint neck is not positive definite'),
        ({'covariance': [1.0, 2.0, 2.0, 1.0] * 3}, r'neck is not positive definite: .* -1$'),
        ({'covariance': [1.0, 0.5, 0.0, 1.0] * 3}, r'covariance of keypoint neck is not symmetric'),
        (
            {'covariance': [np.nan, 0.0, 0.0, 1.0] * 3},
            r'covariance of keypoint neck has values that are not',
        ),
    ],
)
def test_messages_that_contradict_themselves(messages, changes, error):
    with pytest.raises(MessageError, match=error) as caught:
        keypoints_of(message(messages, **changes), 3.0)
    assert '\n' not in str(caught.value)


def message_3d(messages, **changes):
    fields: dict[str, Any] = {
        'names': ['head', 'neck', 'nose'],
        'x': [0.1, np.nan, 0.3],
        'y': [-0.5, np.nan, -0.6],
        'z': [0.0, np.nan, 0.2],
        'confidence': [0.5, 1.0, 0.0],
    }
    return messages.create('hmt_msgs/msg/Keypoints3D', **{**fields, **changes})


def test_positions_join_keypoints_by_name(messages):
    found = positions_of(message_3d(messages))
    assert found.names == ('head', 'neck', 'nose')
    np.testing.assert_array_equal(found.positions, [[0.1, -0.5, 0], [np.nan] * 3, [np.nan] * 3])
    joined = found.added_to(keypoints_of(message(messages), 3.0))
    assert joined.names == ('neck', 'left_elbow', 'head')
    np.testing.assert_array_equal(joined.positions, [[np.nan] * 3, [np.nan] * 3, [0.1, -0.5, 0]])
    again = positions_of(positions_message(messages, joined, 7, 'camera'))
    assert again.names == joined.names
    np.testing.assert_array_equal(again.positions, joined.positions)
    without = positions_message(messages, keypoints_of(message(messages), 3.0), 7, 'camera')
    assert (len(without.names), len(without.x), len(without.confidence)) == (0, 0, 0)


def test_a_message_of_nobody(messages):
    """The message of a detector that saw nobody is read: no keypoints, no positions."""
    written = keypoints_message(messages, NO_KEYPOINTS, 7, 'camera')
    found = keypoints_of(written, 3.0)
    assert (found.names, found.pixels.shape, found.covariances.shape) == ((), (0, 2), (0, 2, 2))
    nowhere = positions_of(positions_message(messages, NO_KEYPOINTS, 7, 'camera'))
    assert (nowhere.names, nowhere.positions.shape) == ((), (0, 3))


def test_a_message_without_covariances(messages):
    content = keypoints_of(message(messages), 3.0)
    unknown = replace(content, covariances=np.full((3, 2, 2), np.nan))
    written = keypoints_message(messages, unknown, 7, 'camera')
    assert len(written.covariance) == 0
    np.testing.assert_array_equal(keypoints_of(written, 5.0).covariances[0], 25 * np.eye(2))
    np.testing.assert_array_equal(
        keypoints_of(written, 0.0).covariances[0], np.full((2, 2), np.nan)
    )


@pytest.mark.parametrize(
    ('changes', 'error'),
    [
        ({'names': []}, r'keypoints_3d: x has 3 values, wanted 0'),
        ({'names': ['head', 'neck', 'head']}, r"keypoints_3d has the name 'head' twice"),
        ({'names': ['x'] * 10_001}, r'keypoints_3d has 10001 names, the limit is 10000'),
        ({'z': [1.0, 2.0]}, r'keypoints_3d: z has 2 values, wanted 3'),
        ({'confidence': [1.0]}, r'keypoints_3d: confidence has 1 values, wanted 3'),
        (
            {'x': [np.nan, 1.0, 1.0]},
            r'keypoint head lies at \(nan, -0.5, 0.0\), wanted numbers within',
        ),
        ({'z': [np.inf, np.nan, 1.0]}, r'keypoint head lies at \(0.1, -0.5, inf\)'),
        ({'y': [-1e300, np.nan, 1.0]}, r'lies at \(0.1, -1e\+300, 0.0\), wanted .* within 1000 m'),
        ({'confidence': [1.5, 1.0, 1.0]}, r'head has confidence 1.5, wanted 0 to 1'),
        ({'confidence': [np.nan, 1.0, 1.0]}, r'head has confidence nan'),
    ],
)
def test_positions_that_contradict_themselves(messages, changes, error):
    with pytest.raises(MessageError, match=error) as caught:
        positions_of(message_3d(messages, **changes))
    assert '\n' not in str(caught.value)
