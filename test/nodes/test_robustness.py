"""The cases of the soak, short: after each the node lives, and nothing acknowledged is lost."""

import json

import numpy as np
import pytest

from benchmarks.mutations import damaged, messages_of
from benchmarks.soak import cases, disk, files, messages, nodes
from benchmarks.soak.outcome import MOST_GROWTH, Amount, Outcome
from benchmarks.soak.scenes import scenes
from hmt_ros.experts.model_file import read_arrays, write_arrays
from msg_tools.messages.cdr import deserialise, serialise


def assert_met(outcomes, count):
    outcomes = list(outcomes)
    assert [(x.of, x.done, x.told()) for x in outcomes if not x.met] == []
    assert len(outcomes) == count
    assert all(outcome.times > 0 for outcome in outcomes)
    return outcomes


def test_random_and_damaged_messages():
    found = assert_met(messages.messages(Amount(450, 30.0)), 3)
    assert all(0 < outcome.refused < outcome.times for outcome in found)


def test_damaged_files():
    found = assert_met(files.files(Amount(60, 15.0)), 6)
    assert all(0 < outcome.refused <= outcome.times for outcome in found)


def test_a_disk_that_gets_full():
    found = assert_met(disk.disk(Amount(10, 10.0)), 3)
    assert all(outcome.refused > 0 for outcome in found)


@pytest.mark.ros
def test_a_node_does_not_outlive_its_owner(monkeypatch, executable):
    # Process 1 has not started it.
    monkeypatch.setenv('HMT_ROS_OWNER', '1')
    node = executable('smoother_node', '-p', 'autostart:=false')
    node.process.communicate(timeout=60.0)
    assert node.process.returncode == 0


@pytest.mark.ros
@pytest.mark.parametrize(
    ('node', 'chosen'), [('smoother_node', slice(0, 6)), ('bme_node', slice(5, None))]
)
def test_nodes(node, chosen, monkeypatch):
    monkeypatch.setattr(nodes, 'CASES', nodes.CASES[chosen])
    monkeypatch.setattr(nodes, 'scenes', lambda: {node: scenes()[node]})
    assert_met(nodes.nodes(Amount(6, 20.0)), len(nodes.CASES))


def test_damage_is_damage_and_repeats():
    for scene in scenes().values():
        for message in scene.valid().values():
            data = serialise(message)
            one, other = (damaged(data, np.random.default_rng(1)) for _ in range(2))
            assert one == other != data


def test_made_up_messages_survive_their_bytes():
    from hypothesis import given, settings

    @settings(max_examples=20, database=None)
    @given(messages_of('hmt_msgs/msg/PoseMixture', ('human37',)))
    def check(message):
        data = serialise(message)
        assert serialise(deserialise(data, 'hmt_msgs/msg/PoseMixture')) == data

    check()


def test_what_is_not_met_is_told(monkeypatch, capsys):
    def case(amount):
        yield Outcome('something', 'broken', amount.times, 1, lost=2, growth_mb=MOST_GROWTH + 1.0)
        yield Outcome('something', 'kept', amount.times)

    monkeypatch.setattr(cases, 'CASES', {'one': (case, 7, 3, 1.0)})
    assert cases.main(['--quick', '--json', '--only', 'one']) == 1
    broken, kept = json.loads(capsys.readouterr().out)['one']
    assert (broken['times'], broken['lost'], broken['met']) == (3, 2, False)
    assert kept['met']
    assert cases.main(['--only', 'one']) == 1
    assert '2 lost; wanted at most 150 MB' in capsys.readouterr().out


def test_arrays_that_lie_about_their_size_are_refused(tmp_path):
    path = write_arrays(tmp_path / 'model', read_arrays(disk.MODEL))
    lying = tmp_path / 'lying.npz'
    lying.write_bytes(files.with_member(path.read_bytes(), ['x'], np.random.default_rng(0)))
    with pytest.raises(ValueError, match='not a model file'):
        read_arrays(lying)


def test_models_with_numbers_that_are_none_are_refused(tmp_path):
    arrays = read_arrays(disk.MODEL)
    name = next(name for name, values in arrays.items() if values.dtype.kind == 'f')
    arrays[name] = np.full_like(arrays[name], np.nan)
    with pytest.raises(ValueError, match=f'{name} has values that are not finite'):
        read_arrays(write_arrays(tmp_path / 'model', arrays))
