"""Model files: what is refused, and how it is said."""

import numpy as np
import pytest

from hmt_ros.experts import JointExperts, NearestNeighbours
from hmt_ros.experts.model_file import nested, part, read_arrays, write_arrays


@pytest.fixture(scope='module')
def model(branch_pairs):
    return NearestNeighbours().fit(*branch_pairs)


def test_same_model_same_bytes(model, tmp_path):
    a, b = model.save(tmp_path / 'a.npz'), model.save(tmp_path / 'b')
    assert b.name == 'b.npz'
    assert a.read_bytes() == b.read_bytes()


def test_other_version_is_refused(model, tmp_path):
    path = write_arrays(tmp_path / 'm.npz', model.to_arrays() | {'version': np.array(99)})
    with pytest.raises(ValueError, match="version '99', wanted 1; train it again"):
        NearestNeighbours.load(path)


def test_other_kind_is_refused(model, tmp_path):
    path = model.save(tmp_path / 'm')
    with pytest.raises(ValueError, match="'nearest_neighbours', wanted 'joint_experts'"):
        JointExperts.load(path)


@pytest.mark.parametrize('name', ['kind', 'version'])
def test_a_damaged_header_makes_one_line(name, model, tmp_path):
    path = write_arrays(tmp_path / 'm.npz', model.to_arrays() | {name: np.array('a\nb\x85')})
    with pytest.raises(ValueError, match='wanted') as error:
        NearestNeighbours.load(path)
    assert len(str(error.value).splitlines()) == 1


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match='no such model file'):
        NearestNeighbours.load(tmp_path / 'none.npz')


@pytest.mark.parametrize('content', [b'', b'no archive at all', b'PK\x03\x04 cut off'])
def test_other_files_are_refused(content, tmp_path):
    path = tmp_path / 'm.npz'
    path.write_bytes(content)
    with pytest.raises(ValueError, match='not a model file of hmt_ros'):
        NearestNeighbours.load(path)


def test_foreign_archive_and_pickles_are_refused(tmp_path):
    np.savez(tmp_path / 'a.npz', x=np.zeros(3))
    np.savez(tmp_path / 'b.npz', x=np.array([{'a': 1}], dtype=object))
    for name in ('a.npz', 'b.npz'):
        with pytest.raises(ValueError, match='not a model file of hmt_ros'):
            read_arrays(tmp_path / name)


def test_damaged_model_is_refused(model):
    arrays = model.to_arrays()
    del arrays['targets']
    with pytest.raises(ValueError, match=r'a damaged model file \(KeyError'):
        NearestNeighbours.from_arrays(arrays)


def test_sizes_that_no_model_has_are_refused(model):
    for shape in ([2**30, 2], [3, 0], [-1, 2]):
        arrays = model.to_arrays() | {'shape': np.array(shape)}
        with pytest.raises(ValueError, match=f'{shape[0]} inputs and {shape[1]} outputs, wanted'):
            NearestNeighbours.from_arrays(arrays)


def test_parts_come_back():
    arrays = {'a': np.arange(3), 'b/c': np.ones(2)}
    whole = nested('x', arrays) | {'y': np.zeros(1)}
    assert set(whole) == {'x/a', 'x/b/c', 'y'}
    assert set(part('x', whole)) == set(arrays)


def test_model_that_has_not_learned_is_not_saved(tmp_path):
    with pytest.raises(ValueError, match='call fit first'):
        NearestNeighbours().save(tmp_path / 'm')
