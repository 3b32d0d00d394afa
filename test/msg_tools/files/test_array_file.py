"""Archives of arrays: data alone, of a bounded size."""

import io
import os
import random
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from msg_tools.files.array_file import read_archive


def archive_of(path, header, data):
    """An archive whose only array has this header and these bytes."""
    with zipfile.ZipFile(path, 'w', zipfile.ZIP_DEFLATED) as archive:
        archive.writestr('a.npy', b'\x93NUMPY\x01\x00' + header + data)
    return path


def header_of(text):
    return len(text).to_bytes(2, 'little') + text.encode()


def test_arrays_come_back(tmp_path):
    path = tmp_path / 'a.npz'
    rng = np.random.default_rng(0)
    arrays = {'x': rng.normal(size=(3, 4)), 'name': np.array('walk'), 'none': np.zeros((0, 5))}
    np.savez_compressed(path, **arrays)
    found = read_archive(path)
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


def test_objects_are_never_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (str(tmp_path / 'sprung'),))

    path = tmp_path / 'a.npz'
    np.savez(path, trap=np.array([Trap()], dtype=object))
    with pytest.raises(
        ValueError, match=r'the array trap.npy holds object, wanted numbers or texts'
    ):
        read_archive(path)
    # A pickle in place of an array.
    with zipfile.ZipFile(path, 'w') as archive:
        archive.writestr('a.npy', b'\x80\x04N.')
    with pytest.raises(ValueError, match='magic'):
        read_archive(path)
    assert not (tmp_path / 'sprung').exists()


def test_what_unfolds_to_too_much_is_refused_unread(tmp_path):
    path = tmp_path / 'bomb.npz'
    np.savez_compressed(path, zeros=np.zeros(2_000_000))
    assert path.stat().st_size < 50_000
    message = r'its 1 arrays have 16000128 bytes, wanted at most 10000 arrays and 1000000 bytes'
    with pytest.raises(ValueError, match=message):
        read_archive(path, largest=1_000_000)
    assert read_archive(path)['zeros'].shape == (2_000_000,)


def test_claims_are_compared_with_what_is_there(tmp_path):
    text = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}"
    path = archive_of(tmp_path / 'a.npz', header_of(text.ljust(117) + '\n'), b'\0' * 80)
    with pytest.raises(ValueError, match=r'a.npy claims 8000000000000 bytes, but has 208'):
        read_archive(path)


HEADS = {
    'parentheses': ("'<f8'", '(' * 4000 + ')' * 4000, 'Cannot parse header'),
    'signs': ("'<f8'", '(' + '-' * 9000 + '1,)', 'MemoryError|recursion|Cannot parse'),
    'sums': ("'<f8'", '(' + '1+' * 4500 + '1,)', 'recursion|Cannot parse'),
    'spaces': ("'<f8'", '(1,)' + ' ' * 60_000, 'Header info length'),
    'fields': (str([(f'a{i}', 'u1') for i in range(500)]), '(0,)', 'wanted numbers or'),
    'inner array': ("('<f8', (1000000, 1000000))", '(0,)', 'invalid shape|wanted numbers'),
    'time': ("'<M8[ns]'", '(0,)', r'holds datetime64\[ns\], wanted numbers or texts'),
    'complex': ("'<c16'", '(0,)', 'holds complex128, wanted numbers'),
    'product': ("'<f8'", '(4294967296, 4294967296)', 'claims 147573952589676412928 bytes'),
    'negative': ("'<f8'", '(-1, -5)', 'dimension|EOF'),
    'empty': ("'<f8'", '(0, 1000000000000000000)', 'has shape .0, 1000000000000000000., but'),
    'digits': ("'<f8'", f'({"9" * 4000}, 0)', 'has shape .9999'),
    'long texts': ("'<U1000000000'", '(0,)', 'not a valid dtype|claims'),
}


@pytest.mark.parametrize('name', HEADS)
def test_hostile_heads_are_one_line(name, tmp_path):
    descr, shape, message = HEADS[name]
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n"
    path = archive_of(tmp_path / 'a.npz', header_of(text), b'')
    with pytest.raises(ValueError, match=message) as caught:
        read_archive(path)
    assert len(str(caught.value).splitlines()) == 1


def test_what_unfolds_is_in_proportion_to_the_file(tmp_path):
    """With an archive of zeros, many names for one array, and bytes that become larger numbers."""
    path = tmp_path / 'bomb.npz'
    np.savez_compressed(path, zeros=np.zeros(20_000_000))
    with pytest.raises(ValueError, match='it unpacks to more than'):
        read_archive(path)
    np.savez_compressed(path, zeros=np.zeros(1_000_000))
    whole = path.read_bytes()
    start, end = whole.index(b'PK\x01\x02'), whole.index(b'PK\x05\x06')
    names = whole[start:end] * 2000
    last = struct.pack('<HHHHIIH', 0, 0, 2000, 2000, len(names), start, 0)
    path.write_bytes(whole[:start] + names + b'PK\x05\x06' + last)
    with pytest.raises(ValueError, match='its 2000 arrays have 16000256000 bytes'):
        read_archive(path)
    np.savez_compressed(path, bytes=np.zeros(10_000_000, np.int8))
    with pytest.raises(ValueError, match='claims 40000000 bytes'):
        read_archive(path, largest=20_000_000)
    assert read_archive(path)['bytes'].shape == (10_000_000,)


@pytest.mark.parametrize('content', [b'', b'PK', b'not an archive at all'])
def test_other_files(content, tmp_path):
    path = tmp_path / 'a.npz'
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r'(?i)zip file|no data|pickle|magic') as caught:
        read_archive(path)
    assert '\n' not in str(caught.value)
    with pytest.raises(FileNotFoundError):
        read_archive(tmp_path / 'none.npz')
    os.mkfifo(tmp_path / 'pipe.npz')
    with pytest.raises(OSError, match='a pipe or a device, wanted a file'):
        read_archive(tmp_path / 'pipe.npz')


def test_damaged_archives_are_read_or_refused(tmp_path):
    path = tmp_path / 'a.npz'
    buffer = io.BytesIO()
    np.savez_compressed(buffer, x=np.arange(100.0), y=np.array('text'))
    whole = buffer.getvalue()
    rng = random.Random(0)
    refused: list[str] = []
    for _ in range(2000):
        content = bytearray(whole)
        for _ in range(rng.randint(1, 8)):
            content[rng.randrange(len(content))] = rng.randrange(256)
        if rng.random() < 0.2:
            del content[rng.randrange(len(content)) :]
        path.write_bytes(content)
        try:
            read_archive(path)
        except (ValueError, OSError) as error:
            refused.append(str(error))
    assert len(refused) > 1000
    assert not any('\n' in text for text in refused)
