"""Subject files made from keypoints, as the start of a track."""

import numpy as np
import pytest

from hmt_ros.app.first_subject import find_start, subject_text
from hmt_ros.body import Camera
from hmt_ros.image.keypoint_schemes import schemes
from hmt_ros.image.terms.keypoints import Keypoints
from hmt_ros.tracking import read_subject
from msg_tools import BagWriter, RosbagsMessages
from msg_tools.messages.camera_info import camera_info_message
from msg_tools.messages.headers import FRAME_ID, START_NS
from msg_tools.messages.images import compressed_image_message
from msg_tools.messages.keypoints import keypoints_message

MESSAGES = RosbagsMessages()
CAMERA = Camera(100.0, 100.0, 31.5, 23.5, 64, 48)
STEP = 100_000_000


def person(scheme, confidences, *, shift=0.0):
    """Landmark i of a scheme lies at (10 + i + shift, 100 + 2 i)."""
    names = schemes()[scheme].names
    n = len(names)
    pixels = np.stack([10.0 + np.arange(n) + shift, 100.0 + 2 * np.arange(n)], 1)
    sure = np.array([confidences.get(x, 0.9) for x in names])
    return Keypoints(names, pixels, np.tile(np.eye(2), (n, 1, 1)), sure)


def write_bag(path, found):
    with BagWriter(path) as bag:
        for i, keypoints in enumerate(found):
            stamp = START_NS + i * STEP
            image = np.zeros((48, 64, 3), np.uint8)
            bag.write(
                'image/compressed', stamp,
                compressed_image_message(MESSAGES, image, stamp, FRAME_ID),
            )  # fmt: skip
            info = camera_info_message(MESSAGES, CAMERA, stamp, FRAME_ID)
            bag.write('camera_info', stamp, info)
            if keypoints is not None:
                message = keypoints_message(MESSAGES, keypoints, stamp, FRAME_ID)
                bag.write('keypoints', stamp, message)
    return path


def started(bag, body):
    """The subject file made for a bag, as read again."""
    file = bag.parent / 'subject.yaml'
    file.write_text(subject_text(find_start(bag, body), 1.8), 'utf-8')
    return read_subject(file, body)


NOBODY = Keypoints((), np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0))
HIDDEN = {'left_ankle': 0.2, 'right_ankle': 0.2, 'left_knee': 0.2}


def test_first_image_that_shows_enough(tmp_path, human37):
    found = [NOBODY, person('coco17', HIDDEN), person('coco17', {'left_wrist': 0.4}, shift=3.0)]
    bag = write_bag(tmp_path / 'bag', [*found, person('coco17', {})])
    read = started(bag, human37)
    assert read.stamp_ns == START_NS + 2 * STEP
    assert read.stature == 1.8
    names = schemes()['coco17'].names
    # Eyes, ears and nose belong to no joint; the wrist is not seen well.
    assert {*read.keypoints.names} == {*names[5:]} - {'left_wrist'}
    knee = read.keypoints.names.index('right_knee')
    i = names.index('right_knee')
    assert list(read.keypoints.pixels[knee]) == [13.0 + i, 100.0 + 2 * i]
    # 3 % of the height of the person: from the left shoulder (5) to the right ankle (16).
    assert np.allclose(read.keypoints.covariances[0], 2.0**2 * np.eye(2))


@pytest.mark.parametrize(
    ('found', 'message'),
    [
        ([None], 'has no keypoints: import them with the video'),
        ([NOBODY] * 2, '0 joints of human37 are seen with confidence in each image, wanted 4'),
    ],
)
def test_nothing_to_start_from(found, message, tmp_path, human37):
    with pytest.raises(ValueError, match=message):
        find_start(write_bag(tmp_path / 'bag', found), human37)
