"""Files named by peers in parameters: their content is not revealed, and the node survives."""

from __future__ import annotations

import json
import os
import threading
import time
import zipfile
from concurrent.futures import wait as wait_for
from types import SimpleNamespace

import numpy as np
import pytest
from rcl_interfaces.srv import SetParameters

from hmt_ros.nodes import patient_reader
from hmt_ros.nodes.bme_node import BmeNode
from hmt_ros.nodes.filter_node import FilterNode
from hmt_ros.nodes.node_parameters import file_folders
from hmt_ros.nodes.patient_reader import PatientReader
from hmt_ros.nodes.smoother_node import SmootherNode
from hmt_ros.sessions.named_file import FILE_PARAMETERS, check_place

TOKENS = ('Xq7Secret', '4815162342', 'Zw9Hidden')
KINDS = {
    'filter_node': (FilterNode, ('subject_file', 'background_file', 'body_model', 'lifter')),
    'bme_node': (BmeNode, ('model_file', 'background_file', 'lifter')),
    'smoother_node': (SmootherNode, ('body_model',)),
}


def secrets(folder):
    """Files of many kinds that contain the tokens."""
    secret, number, hidden = TOKENS
    texts = {
        'shadow': f'root:{secret}:0:0\ndaemon:*:{number}:{hidden}\n',
        'mapping.yaml': f'{secret}: {number}\n{hidden}: [1, 2]\n',
        'tab.yaml': f'a: 1\n\t{secret}: {number}\n',
        'list.yaml': f'[{number}, {secret}, {hidden}]',
        'subject.yaml': f'stamp_ns: 1\nkeypoints: {{{secret}: [1, {number}], {hidden}: [1, 2]}}',
        'stamp.yaml': f'stamp_ns: {secret}\nkeypoints: {{head: [{number}, {hidden}]}}',
        'body.yaml': f'name: {secret}\nsegments:\n  {hidden}: {{parent: {number}}}\n',
        'extends.yaml': f'extends: {secret}\n{hidden}: {number}\n',
        'tag.yaml': f'!!python/object:{secret} {{{hidden}: {number}}}',
        'alias.yaml': f'a: &{secret} {number}\nb: *{hidden}\n',
        'quote.yaml': f'"{secret} {number} {hidden}',
        'one.json': json.dumps({secret: [number, {hidden: None}]}),
        'scalar.txt': f'{secret}{number}{hidden}' * 10_000,
        'key.pem': f'-----BEGIN {secret}-----\n{number}\n{hidden}\n',
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    (folder / 'binary').write_bytes(bytes(range(256)) + secret.encode() + number.encode())
    (folder / 'fake.png').write_bytes(b'\x89PNG\r\n\x1a\n' + f'{secret}{number}{hidden}'.encode())
    np.savez(folder / 'arrays.npz', **{secret: np.arange(3), hidden: np.array(number)})
    np.savez(folder / 'meta.npz', meta=np.array(json.dumps({'format': secret, hidden: number})))
    with zipfile.ZipFile(folder / 'zip.npz', 'w') as archive:
        archive.writestr(f'{secret}.npy', f'{number}{hidden}')
    (folder / 'empty').touch()
    os.mkfifo(folder / 'fifo')
    (folder / 'folder').mkdir()
    (folder / 'link').symlink_to('/etc/passwd')
    (folder / 'zero').symlink_to('/dev/zero')
    (folder / 'loop').symlink_to(folder / 'loop')
    return sorted(path for path in folder.iterdir())


@pytest.fixture
def node_of(world_of):
    def make(name, **values):
        return world_of(KINDS[name][0], name, {}, autostart=False, **values)

    return make


@pytest.mark.parametrize('name', KINDS)
def test_no_content_of_a_file_is_told(node_of, name, tmp_path):
    files = secrets(tmp_path)
    values = {'predict_from': 'both'} if name == 'bme_node' else {}
    one = node_of(name, file_folders=str(tmp_path), **values)
    for parameter in KINDS[name][1]:
        for file in files:
            good, reason = one.set(**{parameter: str(file)})
            assert not good, (parameter, file)
            assert reason.startswith(f'{parameter}: {file}'), reason
            assert '\n' not in reason
            assert not [token for token in (*TOKENS, 'root:') if token in reason], reason


@pytest.mark.parametrize('name', KINDS)
def test_no_content_of_a_file_of_the_launch_is_told(node_of, name, tmp_path):
    secrets(tmp_path)
    parameter, file = KINDS[name][1][0], tmp_path / 'mapping.yaml'
    one = node_of(name, **{parameter: str(file)})
    assert not one.change_state('configure')
    (text,) = one.warnings()
    assert f'{parameter}: {file}: not a ' in text
    assert '; fix that, then: ros2 lifecycle set' in text
    level, message, _ = one.diagnosis()
    assert (level, message) == (2, text)
    assert not [token for token in TOKENS if token in one.logged]


def test_files_elsewhere_are_refused_whether_or_not_they_exist(
    node_of, subject_file, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    inside = tmp_path / 'allowed'
    inside.mkdir()
    (inside / 'good.yaml').write_bytes(subject_file.read_bytes())
    (tmp_path / 'outside.yaml').write_bytes(subject_file.read_bytes())
    (inside / 'link.yaml').symlink_to(tmp_path / 'outside.yaml')
    one = node_of('filter_node', file_folders='allowed', background_file='outside.yaml')
    reasons = set()
    for path in ('outside.yaml', 'not_there', 'allowed/link.yaml', 'allowed/../x'):
        good, reason = one.set(subject_file=path)
        assert not good
        reasons.add(reason.replace(path, 'PATH'))
    assert reasons == {
        'subject_file: PATH lies in no folder of file_folders, which are allowed: move it '
        'there, or name it at launch'
    }
    # A file named at launch is read, although it is not an image.
    good, reason = one.set(subject_file='')
    assert 'background_file: outside.yaml: not a PNG or JPEG image' in reason
    assert one.set(background_file='')[0]
    assert one.set(subject_file='allowed/good.yaml') == (True, '')


def test_usual_folders(tmp_path, monkeypatch):
    monkeypatch.setenv('HOME', '/')
    monkeypatch.chdir(tmp_path)
    folders = file_folders('')
    assert folders[-1] == str(tmp_path)
    assert '/' not in folders
    assert file_folders('/data:/more:') == ('/data', '/more')
    for parameter, names in FILE_PARAMETERS.items():
        for name in names():
            check_place(parameter, name, ())


def test_hostile_requests_are_answered(node_of):
    from rcl_interfaces.msg import Parameter, ParameterValue

    one = node_of('filter_node')
    text = ParameterValue(type=4, string_value='x' * 10_000_000)
    hostile = [
        Parameter(name='subject_file', value=text),
        Parameter(name='person_id', value=text),
        Parameter(name='y' * 10_000, value=ParameterValue(type=2)),
        Parameter(name='gravity', value=ParameterValue(type=8, double_array_value=[0.0] * 10**5)),
        Parameter(name='gravity_sigma', value=ParameterValue(type=3, double_value=float('nan'))),
        Parameter(name='queue_size', value=ParameterValue(type=2, integer_value=2**62)),
        Parameter(name='body_model', value=ParameterValue(type=0)),
        Parameter(name='queue_size', value=ParameterValue(type=77)),
    ]
    results = one.call(SetParameters, 'set_parameters', parameters=hostile).results
    assert not any(result.successful for result in results)
    assert len(results) == len(hostile)
    assert all(result.reason and '\n' not in result.reason for result in results)
    many = [Parameter(name='queue_size', value=ParameterValue(type=2, integer_value=2))] * 1000
    results = one.call(SetParameters, 'set_parameters', parameters=many).results
    assert {result.reason for result in results} == {'1000 parameters, the limit is 256'}
    assert one.set(queue_size=2) == (True, '')


def test_a_slow_reader_is_not_waited_for():
    reader, free, turns = PatientReader(), threading.Event(), []

    def wait():
        free.wait()
        raise ValueError('nothing')

    def ask(of, action=wait):
        began = time.monotonic()
        with pytest.raises(ValueError, match=r'.') as raised:
            reader.read(of, action, lambda: turns.append(1))
        return str(raised.value), time.monotonic() - began

    text, first = ask('a')
    assert text == 'the files are still being read: ask again later'
    assert first == pytest.approx(patient_reader.MAX_WAIT, abs=0.2)
    assert len(turns) > 10
    # The time for checks is used up, so many requests do not block others.
    began = time.monotonic()
    for _ in range(100):
        assert 'other files' in ask('b')[0]
        ask('a')
    spent = time.monotonic() - began
    assert spent < 2 * patient_reader.MAX_WAIT
    assert threading.active_count() < 20
    free.set()
    wait_for([reader._asked[1]])
    assert ask('a')[0] == 'nothing'
    reader.read('b', SimpleNamespace, lambda: None)
