"""Model files: refused files, and their error messages."""

import numpy as np
import pytest

from hmt_ros.body import load_body
from hmt_ros.body.angle_mixture import read_pose_prior
from hmt_ros.body.learned_file import nested, parameters_of, part, write_arrays
from hmt_ros.body.motion_prior import read_motion_prior
from hmt_ros.experts import JointExperts, Lifter, NearestNeighbours, PosePredictor
from hmt_ros.experts.network_experts import Layers
from test.forged_models import arrays_of, forged, write_forged
from test.test_docs import ROOT


@pytest.fixture(scope='module')
def model(branch_pairs):
    return NearestNeighbours().fit(*branch_pairs)


def test_same_model_same_bytes(model, tmp_path):
    a, b = model.save(tmp_path / 'a.npz'), model.save(tmp_path / 'b')
    assert b.name == 'b.npz'
    assert a.read_bytes() == b.read_bytes()


def test_other_versions_are_refused(model, tmp_path):
    path = write_forged(tmp_path / 'm.npz', model.save(tmp_path / 'm'), {'version': np.array(1)})
    with pytest.raises(ValueError, match='it is of another version'):
        NearestNeighbours.load(path)


def test_other_kind_is_refused(model, tmp_path):
    path = model.save(tmp_path / 'm')
    with pytest.raises(ValueError, match="it is none of kind 'joint_experts'"):
        JointExperts.load(path)


@pytest.mark.parametrize('name', ['format', 'kind', 'version'])
@pytest.mark.parametrize('value', ['a\nsecret\x85' + 1000 * 'b', ['secret'] * 3])
def test_a_strange_header_makes_one_line_that_repeats_nothing_of_it(name, value, model, tmp_path):
    path = write_forged(tmp_path / 'm.npz', model.save(tmp_path / 'm'), {name: np.array(value)})
    with pytest.raises(ValueError, match='train or learn it again') as error:
        NearestNeighbours.load(path)
    assert len(str(error.value).splitlines()) == 1
    assert 'secret' not in str(error.value)


def test_damage_is_told_from_a_model_that_is_wrong(model, tmp_path):
    path = model.save(tmp_path / 'm')
    arrays = arrays_of(path)
    arrays['targets'][3, 1] += 1e-9
    with pytest.raises(ValueError, match='it is damaged, its checksum'):
        NearestNeighbours.load(write_arrays(path, arrays))
    write_arrays(path, forged(arrays, {'targets': arrays['targets'] + 1.0}))
    with pytest.raises(ValueError, match='it does not answer as when'):
        NearestNeighbours.load(path)


def test_a_file_has_a_card_and_its_answer_is_that_of_the_model(model, tmp_path):
    path = model.save(tmp_path / 'm', {'source': 'made up'})
    arrays = arrays_of(path)
    size = sum(x.size for x in model.to_arrays().values())
    assert parameters_of(arrays, 'card') == {'source': 'made up', 'numbers': size}
    mixture = model.predict(arrays['example/input'][None])[0]
    told = arrays['example/answer']
    np.testing.assert_allclose(told[:3], mixture.mean())
    np.testing.assert_allclose(told[3:6] ** 2, np.diagonal(mixture.covariance()))
    np.testing.assert_allclose(told[6:], mixture.log_density(told[None, :3]))


def test_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match='no such model file'):
        NearestNeighbours.load(tmp_path / 'none.npz')


@pytest.mark.parametrize('content', [b'', b'no archive at all', b'PK\x03\x04 cut off'])
def test_other_files_are_refused(content, tmp_path):
    path = tmp_path / 'm.npz'
    path.write_bytes(content)
    with pytest.raises(ValueError, match='not a model file that can be used'):
        NearestNeighbours.load(path)


def test_foreign_archive_and_pickles_are_refused(tmp_path):
    np.savez(tmp_path / 'a.npz', x=np.zeros(3))
    np.savez(tmp_path / 'b.npz', x=np.array([{'a': 1}], dtype=object))
    for name in ('a.npz', 'b.npz'):
        with pytest.raises(ValueError, match='not a model file that can be used'):
            NearestNeighbours.load(tmp_path / name)


def test_a_model_without_an_array_is_refused(model, tmp_path):
    path = write_forged(tmp_path / 'm.npz', model.save(tmp_path / 'm'), {'targets': None})
    with pytest.raises(ValueError, match=r'can be used \(KeyError\); train or learn it again'):
        NearestNeighbours.load(path)


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


SHIPPED = sorted(ROOT.glob('hmt_ros/*/models/*.npz'))


@pytest.mark.parametrize('path', SHIPPED, ids=lambda path: path.stem)
def test_a_file_that_ships_has_a_card_and_shows_damage(path, tmp_path):
    readers = {
        'keypoints': Lifter.load,
        'silhouettes': PosePredictor.load,
        'human37_motion': read_motion_prior,
        'human37_prior': lambda file: read_pose_prior(file, load_body('human37')),
    }
    read, arrays = readers[path.stem], arrays_of(path)
    read(path)
    card = parameters_of(arrays, 'card')
    assert 'NSF EIA-0196217' in card['source']
    assert {'made by', 'licence', 'numbers'} <= card.keys()
    assert ('UI-PRMD' in card['source']) == ('prmd_' in str(card.get('motions')))
    name = next(name for name, values in arrays.items() if values.dtype.kind == 'f')
    damaged = arrays[name].copy()
    damaged.view(np.uint8).ravel()[0] ^= 1
    with pytest.raises(ValueError, match='it is damaged, its checksum is another one'):
        read(write_arrays(tmp_path / 'damaged.npz', arrays | {name: damaged}))


def test_a_network_of_a_million_layers_is_refused_before_it_is_computed():
    layers = {
        'first': np.ones((1, 1)),
        'hidden': np.zeros((10**6, 1, 1)),
        'hidden_biases': np.zeros((10**6, 1)),
        'last': np.ones((1, 3)),
    }
    one, three = np.zeros(1), np.zeros(3)
    with pytest.raises(ValueError, match='1000000 hidden layers, wanted at most 100'):
        Layers.from_arrays(layers | {'first_bias': one, 'last_bias': three}, 1)
