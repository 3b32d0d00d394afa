import pytest

from msg_tools import RosbagsMessages
from msg_tools.messages.cdr import serialise
from msg_tools.messages.headers import header_message, stamp_in

STAMP = 1_700_000_000_123_456_789


@pytest.mark.parametrize('stamp', [STAMP, 0, -5 * 10**9 + 7])
def test_stamp_is_read_from_bytes(stamp):
    data = serialise(header_message(RosbagsMessages(), stamp, 'lens'))
    assert stamp_in(data) == stamp


def test_stamp_of_a_big_endian_message():
    seconds, nanoseconds = divmod(STAMP, 10**9)
    data = b'\0\0\0\0' + seconds.to_bytes(4, 'big') + nanoseconds.to_bytes(4, 'big')
    assert stamp_in(data) == STAMP


@pytest.mark.parametrize('data', [b'', b'\0\1', b'\0\1\0\0\1\2\3\4\5\6\7'])
def test_bytes_that_are_too_short_have_none(data):
    assert stamp_in(data) == 0
