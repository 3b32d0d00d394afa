"""People in messages of other detectors, and refused messages."""

from types import SimpleNamespace

import numpy as np
import pytest

from hmt_ros.image.keypoint_schemes import schemes
from msg_tools import MessageError, RosbagsMessages
from msg_tools.messages.cdr import deserialise, serialise
from msg_tools.messages.detections import (
    people_of_floats,
    people_of_yolo,
    person_of_skeleton,
    stamp_of_floats,
)
from msg_tools.messages.message_types import register_definitions, typestore

COCO = schemes()['coco17']


def skeleton(**points):
    names = schemes()['skeleton2d'].names
    rows = [points.get(name, (0.0, 0.0, 0.0)) for name in names]
    return SimpleNamespace(skeleton=[SimpleNamespace(x=x, y=y, c=c) for x, y, c in rows])


def test_a_skeleton_is_in_units_of_the_image():
    message = skeleton(neck=(0.5, 0.25, 0.75), left_hip=(0.0, 1.0, 1.0), nose=(0.5, 0.5, 0.0))
    person = person_of_skeleton(message, 640, 480)
    keypoints = person.keypoints
    assert [n for n, ok in zip(keypoints.names, keypoints.seen) if ok] == ['neck', 'left_hip']
    np.testing.assert_array_equal(keypoints.pixels[keypoints.seen], [[319.5, 119.5], [-0.5, 479.5]])
    np.testing.assert_array_equal(keypoints.confidences[keypoints.seen], [0.75, 1.0])


def test_skeletons_that_are_none():
    message = skeleton()
    message.skeleton.pop()
    with pytest.raises(MessageError, match='Skeleton2D has 17 points, wanted 18'):
        person_of_skeleton(message, 640, 480)
    with pytest.raises(MessageError, match=r'keypoint nose lies at \(nan, 239.5\)'):
        person_of_skeleton(skeleton(nose=(np.nan, 0.5, 1.0)), 640, 480)
    with pytest.raises(MessageError, match=r'nose has confidence 1.5, wanted 0 to 1'):
        person_of_skeleton(skeleton(nose=(0.5, 0.5, 1.5)), 640, 480)


def detection(name, **points):
    """A detection of yolo_ros, whose keypoints are numbered from 1."""
    data = [
        SimpleNamespace(
            id=COCO.names.index(key) + 1 if key in COCO.names else int(key[1:]),
            point=SimpleNamespace(x=u, y=v),
            score=score,
        )
        for key, (u, v, score) in points.items()
    ]
    return SimpleNamespace(id=name, keypoints=SimpleNamespace(data=data))


def test_people_of_yolo():
    dog = detection('1')
    anna = detection('2', left_ankle=(10.0, 20.0, 0.5), nose=(0.0, 0.0, 0.1))
    (person,) = people_of_yolo(SimpleNamespace(detections=[dog, anna]), COCO)
    assert person.name == '2'
    assert person.keypoints.names == COCO.names
    seen = np.flatnonzero(person.keypoints.seen)
    assert seen.tolist() == [COCO.names.index('left_ankle')]
    np.testing.assert_array_equal(person.keypoints.pixels[seen], [[10, 20]])


@pytest.mark.parametrize(
    ('found', 'error'),
    [
        ([detection('1', _18=(1.0, 1.0, 1.0))], 'id 18, wanted 1 to 17 of the scheme coco17'),
        ([detection('1', _0=(1.0, 1.0, 1.0))], 'id 0, wanted 1 to 17'),
        ([detection('7', _3=(1.0, 1.0, 1.0), _03=(1.0, 1.0, 1.0))], "'7' has the keypoint 3 twice"),
        ([detection('1', nose=(1.0, np.inf, 1.0))], r'nose lies at \(1.0, inf\)'),
        ([detection('1')] * 1001, 'message has 1001 people, the limit is 1000'),
    ],
)
def test_people_of_yolo_that_are_none(found, error):
    with pytest.raises(MessageError, match=error) as caught:
        people_of_yolo(SimpleNamespace(detections=found), COCO)
    assert '\n' not in str(caught.value)


def floats(data, *shape, label='', offset=0):
    messages = RosbagsMessages()
    dimensions = [
        messages.create(
            'std_msgs/msg/MultiArrayDimension', size=size, stride=1, label=label if i == 0 else ''
        )
        for i, size in enumerate(shape)
    ]
    layout = messages.create('std_msgs/msg/MultiArrayLayout', dim=dimensions, data_offset=offset)
    content = np.ravel(data).astype(np.float32)
    return messages.create('std_msgs/msg/Float32MultiArray', layout=layout, data=content)


def test_people_of_floats():
    rows = np.arange(2 * 17 * 3, dtype=float).reshape(2, 17, 3)
    rows[..., 2] = 0.5
    both = people_of_floats(floats(rows, 2, 17, 3), COCO)
    assert [person.name for person in both] == ['', '']
    np.testing.assert_array_equal(both[1].keypoints.pixels, rows[1, :, :2])
    np.testing.assert_array_equal(both[0].keypoints.confidences, np.full(17, 0.5))
    (one,) = people_of_floats(floats(rows[1, :, :2], 17, 2), COCO)
    np.testing.assert_array_equal(one.keypoints.pixels, rows[1, :, :2])
    np.testing.assert_array_equal(one.keypoints.confidences, np.ones(17))
    for message in (floats(rows[1]), floats([7.0, *rows[1].ravel()], 17, 3, offset=1)):
        (same,) = people_of_floats(message, COCO)
        np.testing.assert_array_equal(same.keypoints.pixels, rows[1, :, :2])
    assert people_of_floats(floats([]), COCO) == []
    assert people_of_floats(floats([], 0, 17, 3), COCO) == []


@pytest.mark.parametrize(
    ('message', 'error'),
    [
        (floats(np.ones(50)), 'array has 50 numbers in no dimensions, wanted 17x2 or 17x3'),
        (floats(np.ones(54), 18, 3), 'array has 54 numbers in 18x3 dimensions, wanted 17x2'),
        (floats(np.ones(51), 3, 17), 'in 3x17 dimensions'),
        (floats(np.ones(51), 17, 2), 'array has 51 numbers in 17x2 dimensions'),
        (floats(np.ones(1), 2**31, 2**31, 2**31), 'array has 1 numbers'),
        (floats(np.full((17, 2), np.inf), 17, 2), r'nose lies at \(inf, inf\)'),
        (floats(np.ones((1001, 17, 2)), 1001, 17, 2), 'has 1001 people, the limit is 1000'),
    ],
)
def test_floats_that_are_no_people(message, error):
    with pytest.raises(MessageError, match=error):
        people_of_floats(message, COCO)


@pytest.mark.parametrize(
    ('label', 'stamp'),
    [('1700000000000000001', 1_700_000_000_000_000_001), ('', None), ('rows', None), ('-1', None)],
)
def test_stamps_of_floats(label, stamp):
    assert stamp_of_floats(floats(np.ones((17, 2)), 17, 2, label=label)) == stamp
    assert stamp_of_floats(floats(np.ones(34))) is None


def test_messages_of_another_package_can_be_read(tmp_path):
    (tmp_path / 'Spot.msg').write_text('float32 x\nfloat32 y\n', 'utf-8')
    (tmp_path / 'Spots.msg').write_text('std_msgs/Header header\nSpot[2] spots\n', 'utf-8')
    register_definitions('foreign_msgs', tmp_path)
    register_definitions('foreign_msgs', tmp_path)
    spot = typestore().types['foreign_msgs/msg/Spot']
    messages = RosbagsMessages()
    sent = messages.create('foreign_msgs/msg/Spots', spots=[spot(1.0, 2.0), spot(3.0, 4.0)])
    read = deserialise(serialise(sent), 'foreign_msgs/msg/Spots')
    assert [(each.x, each.y) for each in read.spots] == [(1.0, 2.0), (3.0, 4.0)]
    (tmp_path / 'Bad.msg').write_text('float32\n', 'utf-8')
    with pytest.raises(ValueError, match=r'messages of foreign_msgs in .* can not be understood'):
        register_definitions('foreign_msgs', tmp_path)
