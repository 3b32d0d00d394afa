"""The documentation is correct: its code runs, its commands parse, its names exist."""

import importlib
import pkgutil
import re
import runpy
import shlex
from itertools import pairwise
from pathlib import Path

import pytest

from hmt_learning import app as learning
from hmt_ros import app
from hmt_ros.evaluation.pose_scores import Scores
from hmt_ros.sessions import (
    bme_session,
    hri_session,
    keypoints_session,
    people_session,
    smoothed_messages,
    track_messages,
)
from hmt_ros.sessions.bme_parameters import BmeParameters
from hmt_ros.sessions.declared_parameters import declared_parameters
from hmt_ros.sessions.hri_parameters import HriParameters
from hmt_ros.sessions.keypoints_session import KeypointsParameters
from hmt_ros.sessions.smoother_parameters import SmootherParameters
from hmt_ros.sessions.tracking_parameters import FilterParameters, PeopleParameters
from msg_tools import typestore

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / 'benchmarks' / 'results'
PAGES = [
    ROOT / 'README.md',
    ROOT / 'CONTRIBUTING.md',
    ROOT / 'bags' / 'README.md',
    *sorted((ROOT / 'docs').glob('*.md')),
]
PAGE_IDS = [str(path.relative_to(ROOT)) for path in PAGES]
BLOCK = re.compile(r'^(<!-- run -->\n)?```(\w+)\n(.*?)^```$', re.MULTILINE | re.DOTALL)
# Parameters and published topics of the nodes.
NODES = {
    'filter_node': (FilterParameters(), track_messages.TOPICS_OF_NODE),
    'smoother_node': (SmootherParameters(), smoothed_messages.TOPICS),
    'bme_node': (BmeParameters(), bme_session.BmeSession.TOPICS),
    'keypoints_node': (KeypointsParameters(), keypoints_session.TOPICS),
    'people_node': (PeopleParameters(), people_session.PeopleSession.TOPICS),
    'hri_node': (
        HriParameters(),
        hri_session.TOPICS
        | {hri_session.body_topic('<id>', name): x for name, x in hri_session.BODY_TOPICS.items()},
    ),
}
# Commands of each package.
COMMANDS = {'hmt_ros': app.COMMANDS, 'hmt_learning': learning.COMMANDS}
# Programs that are not part of this repository.
FOREIGN = {
    'export',
    'sudo',
    'source',
    'rosdep',
    'pip',
    'colcon',
    'ros2',
    'rviz2',
    'sed',
    'git',
    'ln',
    'rosdoc2',
    'sphinx-build',
    'install/hmt_ros/lib/hmt_ros/filter_node',
}


def blocks(page, language):
    """Code of a page in a language, and whether it is marked to be run."""
    found = BLOCK.findall(page.read_text('utf-8'))
    return [(code, bool(mark)) for mark, kind, code in found if kind == language]


def commands(page):
    """Commands in the bash blocks of a page."""
    for code, run in blocks(page, 'bash'):
        for line in code.replace('\\\n', ' ').splitlines():
            words = shlex.split(line, comments=True)
            if words:
                yield words, run


@pytest.fixture
def workplace(tmp_path, monkeypatch):
    """A working folder with the bags of the repository for commands of the documentation."""
    (tmp_path / 'bags').symlink_to(ROOT / 'bags')
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize('page', PAGES, ids=PAGE_IDS)
def test_links_lead_somewhere(page):
    text = page.read_text('utf-8')
    links = re.findall(r'\]\(([^)\s]+)\)', text)
    for link in links:
        if link.startswith(('http://', 'https://')):
            continue
        path, _, anchor = link.partition('#')
        target = (page.parent / path).resolve() if path else page
        assert target.is_file(), link
        if anchor:
            headings = re.findall(r'^#+ (.*)$', target.read_text('utf-8'), re.MULTILINE)
            slugs = {re.sub(r'[^\w\- ]', '', x).strip().lower().replace(' ', '-') for x in headings}
            assert anchor in slugs, link


@pytest.mark.parametrize(
    'page', [page for page in PAGES if blocks(page, 'python')], ids=lambda page: page.stem
)
def test_python_of_a_page_runs(page, workplace, capsys):
    namespace = {'__name__': 'page'}
    for code, _ in blocks(page, 'python'):
        exec(compile(code, str(page), 'exec'), namespace)
    assert capsys.readouterr().out


@pytest.mark.parametrize('page', PAGES, ids=PAGE_IDS)
def test_commands_are_understood(page):
    targets = set(re.findall(r'^([a-z]+):', (ROOT / 'Makefile').read_text('utf-8'), re.MULTILINE))
    for words, _ in commands(page):
        if words[:2] == ['python', '-m'] and words[2] in COMMANDS:
            parse(words[2], words[3:])
        elif words[:3] == ['python', '-m', 'benchmarks']:
            assert (RESULTS / f'{words[3]}.md').is_file(), words
        elif words[0] == 'python':
            assert words[1].startswith('examples/'), words
            assert (ROOT / words[1]).is_file(), words
        elif words[0] == 'make':
            named = [word for word in words[1:] if '=' not in word]
            assert set(named) <= targets, words
        else:
            assert words[0] in FOREIGN, words
        if words[:3] == ['ros2', 'run', 'hmt_ros'] and words[3] in app.COMMANDS:
            parse('hmt_ros', words[3:])
        elif words[:3] == ['ros2', 'run', 'hmt_ros']:
            given = {b.partition(':=')[0] for a, b in pairwise(words) if a == '-p'}
            together = [node for node in words if node in NODES] or [*NODES]
            known = (declared_parameters(NODES[node][0]) for node in together)
            assert given <= {p.name for every in known for p in every}


def parse(package, words):
    """Fails if a command of a package does not accept the arguments."""
    if words == ['--help']:
        return
    module = importlib.import_module(COMMANDS[package][words[0]][0])
    module._parser().parse_args(words[1:])


def test_marked_commands_run(workplace, capsys):
    """The first steps of the README, from a rendered bag to its evaluation."""
    ran = []
    for words, run in commands(ROOT / 'README.md'):
        if run:
            assert words[:2] == ['python', '-m']
            module = importlib.import_module(COMMANDS[words[2]][words[3]][0])
            assert module.main(words[4:]) == 0, capsys.readouterr().err
            ran.append(words[3])
    assert ran == ['make-bag', 'replay', 'evaluate', 'evaluate', 'report']
    assert '"fraction_tracked"' in capsys.readouterr().out
    assert (workplace / 'reach_report' / 'report.html').is_file()


def page_of(node):
    """The page of a node."""
    return (ROOT / 'docs' / f'{node}.md').read_text('utf-8')


def test_generated_parts_are_up_to_date():
    generate = runpy.run_path(str(ROOT / 'docs' / 'generate.py'))
    for node in NODES:
        page = page_of(node)
        fresh = generate['with_part'](page, node, generate['parameter_table'](node))
        assert page == fresh, f'run: python docs/generate.py {node}'
    assert set(generate['NODES']) == {*NODES}
    with pytest.raises(ValueError, match="no part 'weather'"):
        generate['with_part'](page, 'weather', '')


def rows(page, heading):
    """Cells of the tables under a heading, without their heads."""
    text = page.partition(f'{heading}\n')[2]
    text = re.split(r'^#', text, maxsplit=1, flags=re.MULTILINE)[0]
    lines = [line for line in text.splitlines() if line.startswith('|')]
    return [[cell.strip() for cell in line.strip('|').split('|')] for line in lines[2:]]


@pytest.mark.parametrize('node', NODES)
def test_topics_of_a_node(node):
    published = {row[0].strip('`'): row[1] for row in rows(page_of(node), '## Published topics')}
    wanted = {topic: kind.msgtype.replace('/msg/', '/') for topic, kind in NODES[node][1].items()}
    assert {topic: published[topic] for topic in wanted} == wanted
    assert set(published) - set(wanted) == {'/diagnostics', '~/handled'}


@pytest.mark.parametrize('page', PAGES, ids=PAGE_IDS)
def test_modules_exist(page):
    """Dotted names and paths of the packages exist as a module, a folder or a name in one."""
    text = page.read_text('utf-8')
    for name in re.findall(r'`((?:hmt_ros|hmt_learning|msg_tools)(?:\.\w+)+)`', text):
        assert pkgutil.resolve_name(name), name
    for name in re.findall(
        r'`((?:hmt_ros|hmt_learning|msg_tools|test|benchmarks)/[\w/.*]*)`', text
    ):
        assert list(ROOT.glob(name.rstrip('/'))), name


def test_page_on_numbers_explains_every_field():
    page = (ROOT / 'docs' / 'numbers.md').read_text('utf-8')
    explained = {name for row in rows(page, '## One message') for name in codes(row[0])}
    fields = typestore().fielddefs
    constants, mixture = fields['hmt_msgs/msg/PoseMixture']
    wanted = {name for name, _ in mixture} - {'header', 'body_model', 'dof_names', 'joint_names'}
    wanted |= {f'components[].{name}' for name, _ in fields['hmt_msgs/msg/PoseComponent'][1]}
    assert wanted <= explained
    assert explained - wanted == {'header.stamp', 'header.frame_id'}
    assert {name for name, _, _ in constants} <= set(codes(page))


def codes(text):
    """The parts of a text in backticks."""
    return re.findall(r'`([^`\n]+)`', text)


def test_numbers_of_evaluate_are_explained():
    text = (ROOT / 'docs' / 'evaluation.md').read_text('utf-8')
    named = set(re.findall(r'`([a-z_0-9]+)`', text))
    fields = set(Scores.__dataclass_fields__)
    explained = {
        'fraction_tracked',
        'frames_lost',
        'modes',
        'perplexity',
        'negative_log_likelihood',
    }
    explained |= {f'{name}_mm' for name in ('heaviest', 'best', 'expected')}
    explained |= {f'{kind}coverage_{q}' for kind in ('', 'joint_') for q in (50, 90)}
    assert explained <= named
    assert {'heaviest', 'best', 'expected', 'modes', 'perplexity'} <= fields


def test_every_page_is_in_the_contents():
    index = (ROOT / 'docs' / 'index.md').read_text('utf-8')
    trees = re.findall(r'```{toctree}\n(.*?)```', index, re.DOTALL)
    lines = [line for tree in trees for line in tree.splitlines()]
    listed = [line for line in lines if line and not line.startswith(':')]
    pages = {page.stem for page in (ROOT / 'docs').glob('*.md')} - {'index'}
    assert sorted(listed) == sorted(pages), 'list every page once in docs/index.md'


@pytest.mark.parametrize('page', PAGES, ids=PAGE_IDS)
def test_types_exist(page):
    folder = ROOT / 'msg_tools' / 'hmt_msgs'
    for name in re.findall(r'hmt_msgs/(?:msg/)?([A-Z]\w+)', page.read_text('utf-8')):
        assert (folder / 'msg' / f'{name}.msg').is_file() or (
            folder / 'srv' / f'{name}.srv'
        ).is_file()
