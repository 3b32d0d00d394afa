from pathlib import Path

import pytest
import yaml

from docs.generate import parameter_file_text
from hmt_ros.sessions.declared_parameters import values_of, with_values
from hmt_ros.sessions.parameter_file import read_parameter_file, yaml_scalar
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters

ROOT = Path(__file__).resolve().parents[2]
CONFIG = ROOT / 'hmt_ros' / 'config' / 'filter_node.yaml'


def test_file_of_the_node_is_what_it_declares():
    wanted = parameter_file_text('filter_node', FilterParameters())
    assert CONFIG.read_text('utf-8') == wanted, 'write it: python docs/generate.py filter_node'
    assert max(len(line) for line in wanted.splitlines()) <= 100
    assert read_parameter_file(CONFIG, 'filter_node') == values_of(FilterParameters())


def test_what_two_nodes_have_alike_is_written_once():
    file = CONFIG.with_name('people_node.yaml')
    wanted = parameter_file_text(
        'people_node', PeopleParameters(), 'filter_node', FilterParameters()
    )
    assert file.read_text('utf-8') == wanted, 'write it: python docs/generate.py people_node'
    own, shared = read_parameter_file(file, 'people_node'), values_of(FilterParameters())
    assert list(own) == ['source', 'max_people', 'use_keypoints', 'frame_prefix']
    assert shared | own == values_of(PeopleParameters())
    assert '# All others are those of filter_node: see filter_node.yaml.' in wanted


def test_other_values_survive(tmp_path):
    changed = with_values(
        FilterParameters(),
        {'subject_file': "it's: #1", 'camera_height': 1e-5, 'publish_tf': False},
    )
    path = tmp_path / 'changed.yaml'
    path.write_text(parameter_file_text('filter_node', changed))
    assert with_values(FilterParameters(), read_parameter_file(path, 'filter_node')) == changed


@pytest.mark.parametrize('value', [True, 3, 1e-7, 0.25, float('inf'), '', 'yes', "a'b", '1.5'])
def test_scalars_keep_their_type(value):
    read = yaml.safe_load(yaml_scalar(value))
    assert read == value
    assert type(read) is type(value)


def test_sections_are_chosen_by_the_name_of_the_node(tmp_path):
    path = tmp_path / 'launch.yaml'
    path.write_text(
        '/camera:\n  ros__parameters: {rate: 30}\n'
        'filter_node:\n  ros__parameters:\n    max_hypotheses: 4\n'
        '    background: {method: knn}\n'
        '/**:\n  ros__parameters: {max_hypotheses: 6, dynamics.model: learned}\n'
    )
    assert read_parameter_file(path, 'filter_node') == {
        'max_hypotheses': 4,
        'dynamics.model': 'learned',
        'background.method': 'knn',
    }
    assert read_parameter_file(path, 'other') == {
        'max_hypotheses': 6,
        'dynamics.model': 'learned',
    }


def test_files_without_sections(tmp_path):
    path = tmp_path / 'plain.yaml'
    path.write_text('max_hypotheses: 4\nbackground:\n  method: knn\n')
    assert read_parameter_file(path, 'filter_node') == {
        'max_hypotheses': 4,
        'background.method': 'knn',
    }
    path.write_text('')
    assert read_parameter_file(path, 'filter_node') == {}


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        (None, r'can not be read \(No such file'),
        ('a: [', 'not YAML'),
        ('- 1\n- 2\n', 'wanted parameters by name, saw list'),
        ('/**:\n  ros__parameters: 3\n', 'wanted parameters by name, saw 3'),
        ('/**:\n  ros__parameters: {}\nother: 3\n', "section 'other' has no ros__parameters"),
        ('#' * 250_001, '250001 bytes, wanted at most 250000'),
    ],
)
def test_files_that_are_none(tmp_path, text, message):
    path = tmp_path / 'wrong.yaml'
    if text is not None:
        path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_parameter_file(path, 'filter_node')
    assert str(path) in str(caught.value)
    assert '\n' not in str(caught.value)
