"""Bodies from YAML files, and one clear error line for invalid files."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest
import yaml

from hmt_ros.body import load_body

TEXT = (resources.files('hmt_ros.body') / 'models' / 'human37.yaml').read_text('utf-8')


def write(path, change) -> str:
    content = yaml.safe_load(TEXT)
    change(content)
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return str(path)


def test_a_copy_of_the_model_is_the_same_body(tmp_path, random_poses):
    path = write(tmp_path / 'own.yaml', lambda content: None)
    own, shipped = load_body(path), load_body('human37')
    assert own.dof_names == shipped.dof_names
    poses = random_poses(own, 3, 0)
    np.testing.assert_array_equal(own.joint_positions(poses), shipped.joint_positions(poses))
    assert own.flesh.parts == shipped.flesh.parts


def test_a_file_may_extend_a_body_that_ships(tmp_path):
    path = tmp_path / 'stiff.yaml'
    path.write_text('name: stiff\nextends: human34\nfixed: ["{side}_wrist_y", neck_y]\n')
    body = load_body(path)
    assert body.name == 'stiff'
    assert body.dimension == 34 - 3
    assert not {'left_wrist_y', 'right_wrist_y', 'neck_y', 'trunk_z'} & set(body.dof_names)


WRONG = {
    'no lengths': (lambda c: c.pop('lengths'), 'lengths'),
    'no segments': (lambda c: c.pop('segments'), 'segments'),
    'no joints': (lambda c: c.pop('joints'), 'joints'),
    'no name': (lambda c: c.pop('name'), 'name'),
    'no stature': (lambda c: c.pop('stature'), 'stature'),
    'unknown parent': (lambda c: c['segments'][1].update(parent='pelwis'), 'pelwis'),
    'unknown length': (lambda c: c['segments'][1].update(length='torso'), 'torso'),
    'unknown length in an offset': (
        lambda c: c['segments'][4].update(offset=['0.5 * shoulder_wide', 0, 0]), 'shoulder_wide'
    ),
    'unknown axis': (
        lambda c: c['segments'][1].update(dofs=[['trunk_x', 'w', -1, 1]]), "'w' is not one of"
    ),
    'unknown end': (lambda c: c['joints'].update(head=['head', 'middle']), "saw 'middle'"),
    'unknown segment of a joint': (lambda c: c['joints'].update(head=['skull', 'end']), 'skull'),
    'unknown segment of a chain': (lambda c: c['chains'].update(neck=['skull']), 'skull'),
    'unknown fixed dof': (lambda c: c.update(fixed=['trunk_w']), 'trunk_w'),
    'unknown stature length': (lambda c: c.update(stature=['thing']), 'thing'),
    'limits the wrong way round': (
        lambda c: c['segments'][1].update(dofs=[['trunk_x', 'x', 45, -120]]), 'trunk_x'
    ),
    'limits that are words': (
        lambda c: c['segments'][1].update(dofs=[['trunk_x', 'x', 'low', 'high']]), 'low'
    ),
    'limits missing': (lambda c: c['segments'][1].update(dofs=[['trunk_x', 'x']]), ''),
    'lengths that are a list': (lambda c: c.update(lengths=[1, 2]), ''),
    'segments that are a word': (lambda c: c.update(segments='all'), ''),
    'length that is a word': (lambda c: c['lengths'].update(thigh=['long', 0.1]), 'long'),
    'negative radii': (
        lambda c: c['segments'][0].update(flesh={'radii': [-0.1, 0.1, 0.1]}), 'radii'
    ),
    'flesh without a length': (lambda c: c['segments'][0].update(flesh={'radii': [0.1, 0.1]}), ''),
    'extends a file': (lambda c: c.update(extends='/etc/passwd'), "it extends '/etc/passwd'"),
    'a name that formats': (
        lambda c: c['segments'][0].update(name='{side}{side:>1000000000}'),
        'is not in list',
    ),
    'lengths of a planet': (lambda c: c['lengths'].update(x=[1e308, 0.1]), 'below 1000 m'),
    'rings': (
        lambda c: next(x for x in c['segments'] if 'flesh' in x)['flesh'].update(rings=10**9),
        'rings must be 1 to 100, saw 1000000000',
    ),
    'extends nothing': (lambda c: c.update(extends='human99'), 'human99'),
    'extends itself': (lambda c: c.update(extends='human37', fixed=['nothing']), 'nothing'),
    'axis along the segment': (
        lambda c: c['segments'][0].update(points=[1, 0, 0], x_axis=[1, 0, 0]), ''
    ),
}  # fmt: skip


@pytest.mark.parametrize('case', WRONG)
def test_a_wrong_file_is_refused_with_one_line_that_names_it(case, tmp_path):
    change, word = WRONG[case]
    path = write(tmp_path / 'wrong.yaml', change)
    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        load_body(path)
    message = str(caught.value)
    assert '\n' not in message
    assert word in message
    assert 'wrong.yaml' in message


def of_segment(content, name):
    return next(x for x in content['segments'] if x['name'] == name)


def test_flesh_grows_with_the_length_that_its_size_names(tmp_path):
    def change(content):
        of_segment(content, 'trunk')['flesh']['size'] = 'hip_width'
        of_segment(content, '{side}_thigh')['flesh'].pop('size', None)

    body = load_body(write(tmp_path / 'own.yaml', change))
    names = body.skeleton.length_names
    of = {body.skeleton.segment_names[x.segment]: x for x in body.shapes}
    assert names[of['trunk'].size] == 'hip_width'
    # Without an entry a part grows with the length of its segment.
    assert names[of['left_thigh'].size] == names[of['right_thigh'].size] == 'thigh'


def test_a_misspelt_entry_of_a_segment_is_refused(tmp_path):
    """`dof` instead of `dofs` would silently give a stiff joint."""

    def misspell(content):
        content['segments'][1]['dof'] = content['segments'][1].pop('dofs')

    path = write(tmp_path / 'wrong.yaml', misspell)
    with pytest.raises(ValueError, match=r'wrong\.yaml.*dof'):
        load_body(path)


NO_BODY = [
    '', 'just words', '- a\n- list\n', '{unclosed: [1, 2', 'a: b: c', '\t',
    '!!python/object:os.system x',
]  # fmt: skip


@pytest.mark.parametrize('text', NO_BODY)
def test_text_that_is_no_body_is_refused(text, tmp_path):
    path = tmp_path / 'text.yaml'
    path.write_text(text)
    with pytest.raises(ValueError, match=r'text\.yaml: not a body model') as caught:
        load_body(path)
    assert '\n' not in str(caught.value)


def test_a_huge_file_is_refused_unread(tmp_path):
    path = tmp_path / 'huge.yaml'
    path.write_text('#' * 2_000_000)
    with pytest.raises(ValueError, match='2000000 bytes'):
        load_body(path)


def test_an_unknown_name_lists_what_there_is(tmp_path):
    with pytest.raises(FileNotFoundError, match=r'human32.*human34.*human37'):
        load_body('human35')
    with pytest.raises(FileNotFoundError, match='no body'):
        load_body(tmp_path)
