"""Pickles as plain data: what is read, and that nothing of them is carried out."""

import os
import pickle

import numpy as np
import pytest

from msg_tools.files.array_file import read_archive
from msg_tools.files.budget import Budget
from msg_tools.files.plain_pickle import read_plain_pickle

DATA = {
    'S1': {'Walk 1': [np.arange(12.0).reshape(2, 3, 2), np.ones((2, 3, 2), '>f4')]},
    'order': np.asfortranarray(np.arange(6).reshape(2, 3)),
    'names': np.array(['a', 'bc']),
    'rest': [np.float32(2.5), 3, -(2**40), None, True, 'text', b'bytes', (1, 2), 0.5],
}


@pytest.mark.parametrize('protocol', [2, 3, 4, 5])
def test_plain_data_comes_back(protocol):
    found = read_plain_pickle(pickle.dumps(DATA, protocol))
    assert found['rest'] == DATA['rest']
    for one, other in (
        (found['S1']['Walk 1'][0], DATA['S1']['Walk 1'][0]),
        (found['S1']['Walk 1'][1], DATA['S1']['Walk 1'][1]),
        (found['order'], DATA['order']),
        (found['names'], DATA['names']),
    ):
        assert one.dtype == other.dtype
        assert np.array_equal(one, other)
    mixed = np.empty(3, dtype=object)
    mixed[:] = [[1], 'x', None]
    assert list(read_plain_pickle(pickle.dumps(mixed, protocol))) == [[1], 'x', None]


class Calls:
    """An object whose unpickling calls something."""

    def __init__(self, function, *arguments):
        self.about = function, arguments

    def __reduce__(self):
        return self.about


def test_nothing_is_called(tmp_path):
    mark = tmp_path / 'called'
    inside = np.empty(1, dtype=object)
    inside[0] = Calls(os.mkdir, str(mark))
    for bad in (
        Calls(os.mkdir, str(mark)),
        inside,
        {'a': [Calls(eval, f'open({str(mark)!r}, "w")')]},
    ):
        with pytest.raises(ValueError, match=r'wants to use .*, which is not plain data'):
            read_plain_pickle(pickle.dumps(bad))
        np.savez(tmp_path / 'bad.npz', bad=np.array(bad, dtype=object))
        with pytest.raises(ValueError, match='not plain data'):
            read_archive(tmp_path / 'bad.npz', with_objects=True)
    assert not mark.exists()


def test_other_data_is_refused():
    for bad, message in (
        ({(1, 2): 3}, 'keys that are neither texts nor small numbers'),
        ({1, 2}, 'the opcode EMPTY_SET'),
        (1j, "'builtins complex'"),
        (np.datetime64('2020'), 'wanted plain data'),
        (np.zeros(2, 'f4,i4'), 'wanted plain data'),
    ):
        with pytest.raises(ValueError, match=message):
            read_plain_pickle(pickle.dumps(bad))


def test_claims_are_compared_with_what_is_there():
    """An array that claims more than its bytes, memory of a place far away, a cut end."""
    good = pickle.dumps(np.zeros(4), 4)
    assert b'K\x04\x85' in good
    with pytest.raises(ValueError, match='an array of 1600 bytes, but there are 32'):
        read_plain_pickle(good.replace(b'K\x04\x85', b'K\xc8\x85', 1))
    assert read_plain_pickle(b'\x80\x04]r\xff\xff\xff\x7f.') == []
    for end in range(1, len(good)):
        with pytest.raises(ValueError, match=r'.'):
            read_plain_pickle(good[:end])
    with pytest.raises(ValueError, match='more than 200000 opcodes'):
        read_plain_pickle(b'\x80\x04' + b']' * 210_000 + b'.')


def test_a_list_within_itself_ends():
    held = []
    held.append(held)
    found = read_plain_pickle(pickle.dumps(held))
    assert found[0] is found


def test_memory_and_time_are_bounded():
    """Loops of opcodes that copy what the memo holds, keys that are hashed alike, sides."""
    text, times = b'x' * 1_000_000, 200
    encode = b'\x8c\x07_codecs\x8c\x06encode\x93\x94X' + len(text).to_bytes(4, 'little') + text
    loop = b'\x80\x04' + encode + b'\x94\x8c\x06latin1\x94](' + b'h\x00h\x01h\x02\x86R' * times
    with pytest.raises(ValueError, match='it unpacks to more than'):
        read_plain_pickle(loop + b'e.', Budget(0))
    many = pickle.dumps([np.frombuffer(text, 'u1')] * 2 + [np.frombuffer(text, 'u1')] * 2, 5)
    assert len(read_plain_pickle(many, Budget(0))) == 4
    with pytest.raises(ValueError, match='neither texts nor small numbers'):
        read_plain_pickle(pickle.dumps({k * (2**61 - 1): 0 for k in range(1, 9)}))
    sides = pickle.dumps(np.zeros(4), 4).replace(
        b'K\x04\x85', b'\x8a\x09' + b'\x7f' * 9 + b'\x85', 1
    )
    with pytest.raises(ValueError, match='sides are no numbers'):
        read_plain_pickle(sides)


def test_lists_that_hold_themselves_or_each_other_are_not_followed(tmp_path):
    loop, tower = [], [1.0] * 10
    loop.append(loop)
    for _ in range(50):
        tower = [tower] * 10
    for bad in (loop, tower):
        assert isinstance(read_plain_pickle(pickle.dumps(bad)), list)
        held = np.empty((), object)
        held[()] = bad
        np.savez(tmp_path / 'a.npz', a=held)
        assert read_archive(tmp_path / 'a.npz', with_objects=True)['a'].shape == ()
