"""replay of many bags: what is skipped, what is done anew, and the same bytes through Dask."""

import json

import pytest

from hmt_ros.app.make_bag import main as make_bag
from hmt_ros.app.replay import main
from msg_tools import BagReader

TINY = ['--fps', '10', '--size', '240x180', '--fov', '40']
FAST = ['--set', 'max_hypotheses=2', '--set', 'candidates=3', '--set', 'combinations=8']
FAST += ['--no-smoother']
PERSON = ['--subject', '{bag}/subject.yaml', '--background', '{bag}/background.png', *FAST]


@pytest.fixture(scope='module')
def archive(tmp_path_factory):
    """Two bags of two images, at different depths."""
    folder = tmp_path_factory.mktemp('archive')
    assert make_bag(['reach', '-o', str(folder / 'a'), '--duration', '0.2', *TINY]) == 0
    assert make_bag(['walk', '-o', str(folder / 'day' / 'b'), '--duration', '0.2', *TINY]) == 0
    return folder


@pytest.fixture(scope='module')
def tracked(archive, tmp_path_factory):
    """The new bags, one after the other."""
    out = tmp_path_factory.mktemp('out') / 'tracked'
    assert main([str(archive), '-o', str(out), '--quiet', *PERSON]) == 0
    return out


def content(folder):
    """Bytes of all bags in a folder."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob('*'))
        if path.suffix in ('.mcap', '.yaml')
    }


def test_every_bag_gets_one_of_its_name(archive, tracked, tmp_path):
    assert sorted(path.name for path in tracked.iterdir()) == ['a', 'a.replay.json', 'day']
    for name in ('a', 'day/b'):
        with BagReader(tracked / name) as bag:
            assert bag.topics['pose_mixture'].message_count == 2
        record = json.loads((tracked / f'{name}.replay.json').read_text())
        assert record['done'] is True
        assert (record['images'], record['tracked']) == (2, 2)
        assert record['made_from']['parameters']['filter']['subject_file'].startswith('sha256:')
    # As alone.
    alone = [str(archive / 'a'), '-o', str(tmp_path / 'a'), '--quiet', *PERSON]
    assert main(alone) == 0
    assert (tmp_path / 'a' / 'a.mcap').read_bytes() == (tracked / 'a' / 'a.mcap').read_bytes()
