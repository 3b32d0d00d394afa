import numpy as np
import pytest

from msg_tools import RosbagsMessages
from msg_tools.messages.headers import time_ns
from msg_tools.messages.images import ImageError, decode_depth, depth_message

MESSAGES = RosbagsMessages()
METRES = np.array([[0.0, 1.25, 2.5], [3.0, 0.5, 65.0]], np.float32)


@pytest.mark.parametrize('kind', ['u2', 'f4'])
def test_depths_come_back_in_metres(kind):
    depth = (1000 * METRES).astype(np.uint16) if kind == 'u2' else METRES
    message = depth_message(MESSAGES, depth, 12_000_000_034, 'lens')
    assert message.encoding == {'u2': '16UC1', 'f4': '32FC1'}[kind]
    assert (message.height, message.width, message.step) == (2, 3, 3 * depth.itemsize)
    assert (time_ns(message.header.stamp), message.header.frame_id) == (12_000_000_034, 'lens')
    found = decode_depth(message)
    assert found.dtype == np.float32
    assert np.allclose(found, METRES, rtol=1e-6)


@pytest.mark.parametrize('kind', ['u2', 'f4'])
def test_big_endian_bytes_and_padded_rows(kind):
    depth = (1000 * METRES).astype('>u2') if kind == 'u2' else METRES.astype('>f4')
    message = depth_message(MESSAGES, depth.astype(depth.dtype.newbyteorder('=')), 0, '')
    rows = depth.view(np.uint8).reshape(2, -1)
    message.data = np.concatenate([rows, np.full((2, 5), 77, np.uint8)], axis=1).reshape(-1)
    message.is_bigendian, message.step = 1, rows.shape[1] + 5
    assert np.allclose(decode_depth(message), METRES, rtol=1e-6)


@pytest.mark.parametrize(
    ('changes', 'text'),
    [
        ({'encoding': 'mono8'}, "encoding 'mono8', wanted 16UC1 in mm or 32FC1 in m"),
        ({'step': 5}, 'depth step is 5, wanted at least 6 for 3 16UC1'),
        ({'height': 3}, 'depth has 12 bytes, wanted 18: 3 rows with a step of 6'),
        ({'encoding': '32FC1'}, 'at least 12 for 3 32FC1'),
        ({'width': 0}, 'depth has size 0x2, wanted at least one pixel'),
        ({'width': 2**16, 'height': 2**16}, 'depth has size 65536x65536, the limit is'),
    ],
)
def test_bad_messages_are_refused(changes, text):
    message = depth_message(MESSAGES, (1000 * METRES).astype(np.uint16), 0, '')
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(ImageError, match=text):
        decode_depth(message)
