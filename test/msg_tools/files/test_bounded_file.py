"""Files up to a given size."""

import os

import pytest

from msg_tools.files.bounded_file import read_bytes


def test_content_up_to_the_limit(tmp_path):
    path = tmp_path / 'file'
    path.write_bytes(bytes(range(256)) * 8192)
    assert read_bytes(path, 2**21) == path.read_bytes()
    with pytest.raises(ValueError, match='2097152 bytes, wanted at most 2097151') as caught:
        read_bytes(path, 2**21 - 1)
    assert str(path) not in str(caught.value)


def test_pipes_and_devices_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / 'pipe')  # nobody writes into it: an ordinary open would block for ever
    for path in (tmp_path / 'pipe', '/dev/zero', '/dev/null'):
        with pytest.raises(ValueError, match='a pipe or a device, wanted a file'):
            read_bytes(path, 1000)
    with pytest.raises(ValueError, match='more than its 0 bytes'):
        read_bytes('/proc/self/environ', 1000)


def test_what_can_not_be_read(tmp_path):
    for path, error in ((tmp_path / 'none', 'No such file'), (tmp_path, 'Is a directory')):
        with pytest.raises(ValueError, match=rf'can not be read \({error}'):
            read_bytes(path, 1000)
