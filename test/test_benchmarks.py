"""Every benchmark runs, and has a page of results. Numbers are printed, never asserted."""

import json
from pathlib import Path

import pytest

from benchmarks import BENCHMARKS
from benchmarks.__main__ import main

RESULTS = Path(__file__).resolve().parents[1] / 'benchmarks' / 'results'
OF_NODES = ('live', 'nodes', 'soak')


@pytest.mark.parametrize(
    'name',
    [pytest.param(x, marks=pytest.mark.ros) if x in OF_NODES else x for x in BENCHMARKS],
)
def test_every_benchmark_runs(name, capsys):
    """Where the development data is absent, one that needs it says so."""
    # What a step costs here may be above the table, which is of other machines and clips.
    assert main([name, '--quick', '--json']) in ((0, 1) if name == 'gate' else (0,))
    said = capsys.readouterr()
    if said.out:
        assert 'machine' in json.loads(said.out)
    else:
        (line,) = (x for x in said.err.splitlines() if x.startswith(f'{name}: '))
        assert 'skipped' in line or name == 'gate'


def test_every_benchmark_has_its_page():
    pages = {page.stem: page.read_text('utf-8') for page in RESULTS.glob('*.md')}
    assert set(pages) == {*BENCHMARKS}
    for name, text in pages.items():
        assert text.startswith(f'# {name}: {BENCHMARKS[name]}\n'), name
        assert f'\npython -m benchmarks {name}' in text, name


def test_command_line(capsys):
    assert main(['--help']) == 0
    assert 'tracking' in capsys.readouterr().out
    assert main(['flops']) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("benchmarks: no 'flops', wanted one of absence, bags, ")
