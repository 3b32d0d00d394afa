"""Archives of arrays: data alone, of a bounded size."""

import io
import random
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
    with pytest.raises(ValueError, match=r'the array trap.npy holds Python objects'):
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


@pytest.mark.parametrize('content', [b'', b'PK', b'not an archive at all'])
def test_other_files(content, tmp_path):
    path = tmp_path / 'a.npz'
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r'(?i)zip file|no data|pickle|magic') as caught:
        read_archive(path)
    assert '\n' not in str(caught.value)
    with pytest.raises(FileNotFoundError):
        read_archive(tmp_path / 'none.npz')


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
