"""Structure of the packages: layers, metadata, and installed files."""

import ast
import os
import re
import runpy
import shutil
import subprocess
import sys
import sysconfig
import xml.etree.ElementTree as ET
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import setuptools

import hmt_ros
from hmt_ros.app import COMMANDS
from test.conftest import LONGEST, copy_objects_of_core

ROOT = Path(__file__).resolve().parents[1]
HMT_MSGS = ROOT / 'msg_tools' / 'hmt_msgs'

# Layers import only layers to their right.
LAYERS = [
    'hmt_learning',
    'hmt_ros.app',
    'hmt_ros.nodes',
    'hmt_ros.sessions',
    'msg_tools',
    'hmt_ros.evaluation',
    'hmt_ros.tracking',
    'hmt_ros.smoothing',
    'hmt_ros.experts',
    'hmt_ros.detectors',
    'hmt_ros.image',
    'hmt_ros.flips',
    'hmt_ros.body',
    'hmt_ros.inference',
    'hmt_ros.core',
    'msg_tools.files',
]


def modules():
    """Every module of the Python packages, by name."""
    found = {}
    for package in ('hmt_ros', 'msg_tools', 'hmt_learning'):
        for path in sorted((ROOT / package).rglob('*.py')):
            parts = path.relative_to(ROOT).with_suffix('').parts
            found['.'.join(parts).removesuffix('.__init__')] = path
    return found


MODULES = modules()


def layer_of(module):
    fitting = [layer for layer in LAYERS if f'{module}.'.startswith(f'{layer}.')]
    return max(fitting, key=len, default=None)


@cache
def imported_names(module):
    """Full names of the modules that a module imports, at its top or anywhere."""
    path = MODULES[module]
    package = module if path.name == '__init__.py' else module.rpartition('.')[0]
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text('utf-8'))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ''
            if node.level:
                above = package.split('.')[: len(package.split('.')) - node.level + 1]
                base = '.'.join([*above, *filter(None, [base])])
            names.add(base)
            names.update(f'{base}.{alias.name}' for alias in node.names)
    return frozenset(names)


def test_layers_import_downwards_only():
    place = {layer: i for i, layer in enumerate(LAYERS)}
    upwards = [
        (module, name)
        for module in MODULES
        if (own := layer_of(module)) is not None
        for name in imported_names(module)
        if (layer := layer_of(name)) is not None and place[layer] < place[own]
    ]
    assert upwards == []


def names_learning(text):
    """Imports of hmt_learning in a source text, and strings that name its modules."""
    found = []
    for node in ast.walk(ast.parse(text)):
        named = []
        if isinstance(node, ast.ImportFrom):
            named = [str(node.module)]
        elif isinstance(node, ast.Import):
            named = [alias.name for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            # A possible argument of importlib or a subprocess; sentences contain blanks.
            named = [node.value] if ' ' not in node.value.strip() else []
        found += [name for name in named if re.match(r'hmt_learning\b', name)]
    return found


@pytest.mark.parametrize('module', [x for x in MODULES if not x.startswith('hmt_learning')])
def test_nothing_that_a_robot_has_imports_learning(module):
    assert names_learning(MODULES[module].read_text('utf-8')) == []


def test_every_module_belongs_to_a_layer():
    outside = {name for name in MODULES if layer_of(name) is None}
    assert outside <= {'hmt_ros', 'hmt_ros.__main__'}


def test_only_nodes_and_commands_name_rclpy():
    users = {
        layer_of(name)
        for name in MODULES
        if any(imported.split('.')[0] == 'rclpy' for imported in imported_names(name))
    }
    assert users <= {'hmt_ros.nodes', 'hmt_ros.app'}


def test_all_but_the_nodes_imports_without_ros_and_nothing_slow_before_it_is_needed():
    names = [
        name for name in MODULES if layer_of(name) != 'hmt_ros.nodes' and '__main__' not in name
    ]
    program = (
        'import importlib, sys\n'
        'for missing in ("rclpy", "hmt_msgs", "std_msgs", "sensor_msgs", "geometry_msgs"):\n'
        '    sys.modules[missing] = None\n'
        'sys.modules["hmt_learning"] = None\n'
        'import hmt_ros.app.replay.command, hmt_ros.app.evaluate\n'
        'import hmt_ros.experts, hmt_ros.smoothing, hmt_ros.tracking\n'
        'print([name for name in ("scipy.stats", "matplotlib") if name in sys.modules])\n'
        'for name in sys.argv[1:]:\n'
        '    if name == "hmt_learning":\n'
        '        del sys.modules[name]\n'
        '    importlib.import_module(name)\n'
        'print(len(sys.argv) - 1)\n'
    )
    result = subprocess.run(
        [sys.executable, '-c', program, *names],
        cwd=ROOT,
        env={'PATH': os.environ['PATH']},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stderr) == (0, '')
    assert result.stdout.splitlines() == ['[]', str(len(names))]


def setup_arguments_of(command, monkeypatch):
    """Arguments of setuptools in setup.py for a command."""
    arguments: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, 'setup', lambda **given: arguments.update(given))
    monkeypatch.setattr(sys, 'argv', ['setup.py', command])
    monkeypatch.chdir(ROOT)
    runpy.run_path('setup.py', run_name='__main__')
    return arguments


@pytest.fixture(scope='module')
def setup_arguments():
    """Arguments of setuptools in setup.py."""
    with pytest.MonkeyPatch.context() as patch:
        return setup_arguments_of('install', patch)


def xml(path):
    return ET.parse(path).getroot()


def test_versions_agree(setup_arguments):
    assert setup_arguments['version'] == hmt_ros.__version__
    assert xml(ROOT / 'package.xml').findtext('version') == hmt_ros.__version__
    for folder in (HMT_MSGS, ROOT / 'examples'):
        assert xml(folder / 'package.xml').findtext('version') == hmt_ros.__version__


def test_dependencies_of_package_xml_cover_the_ros_packages_used():
    root = xml(ROOT / 'package.xml')
    declared = {element.text for element in root.iter() if element.tag.endswith('depend')}
    imported = {name.split('.')[0] for module in MODULES for name in imported_names(module)}
    used = {name for name in imported if name.endswith(('_msgs', '_interfaces')) or name == 'rclpy'}
    # hmt_msgs is built by setup.py or earlier by colcon: see test_workspace.py.
    assert used - {'hmt_msgs'} <= declared


def test_package_data_covers_every_data_file(setup_arguments):
    for package, patterns in setup_arguments['package_data'].items():
        for path in (ROOT / package).rglob('*'):
            name = str(path.relative_to(ROOT / package))
            if path.suffix in {'.yaml', '.msg', '.srv', '.npz', '.html', '.js', '.css'}:
                assert any(fnmatch(name, pattern) for pattern in patterns), name


# Data made by others or learned from such data; all other tracked files are our own.
LEARNED = ('hmt_ros/body/models/*', 'hmt_ros/experts/models/*', 'hmt_ros/image/*.yaml')


def tracked_files():
    done = subprocess.run(
        ['git', 'ls-files', '-z'], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        pytest.skip('the sources are no clone of git')
    return [name for name in done.stdout.split('\0') if (ROOT / name).is_file()]


def is_text(path):
    try:
        return '\0' not in path.read_bytes().decode('utf-8')
    except UnicodeDecodeError:
        return False


def test_licences_name_every_file_that_others_had_a_part_in():
    tracked = tracked_files()
    rows = (ROOT / 'LICENSES' / 'README.md').read_text('utf-8').splitlines()
    cells = [row.split('|')[1] for row in rows if row.startswith('| `')]
    named = [name for cell in cells for name in re.findall(r'`([^`]+)`', cell)]
    for name in named:
        assert any(fnmatch(one, name) for one in tracked), f'{name} is not there'
    wanted = [
        one
        for one in tracked
        if not is_text(ROOT / one) or any(fnmatch(one, pattern) for pattern in LEARNED)
    ]
    assert len(wanted) > 20
    for one in wanted:
        assert any(fnmatch(one, name) for name in named), f'LICENSES/README.md does not name {one}'


def test_licences_are_complete_and_installed(setup_arguments):
    text = (ROOT / 'LICENSES' / 'README.md').read_text('utf-8')
    headings = {line[3:].lower() for line in text.splitlines() if line.startswith('## ')}
    assert set(re.findall(r'\]\(#([^)]+)\)', text)) == headings - {'dependencies'}
    for link in re.findall(r'\]\(([^)#:]+)\)', text):
        assert (ROOT / 'LICENSES' / link).is_file(), link
    for said in ('NSF EIA-0196217', 'PDDL', 'CC BY 4.0', 'BSD-3-Clause', 'CC0', 'Apache-2.0'):
        assert said in text
    installed = dict(setup_arguments['data_files'])
    every = sorted(f'LICENSES/{path.name}' for path in (ROOT / 'LICENSES').iterdir())
    assert installed['share/hmt_ros/LICENSES'] == every
    assert 'LICENSE' in installed['share/hmt_ros']
    assert setup_arguments['license_files'] == ['LICENSE', 'LICENSES/*']


def test_entry_points_are_all_nodes_and_commands(setup_arguments):
    lines = setup_arguments['entry_points']['console_scripts']
    points = dict(line.split(' = ') for line in lines)
    nodes = {name for name in points if points[name].startswith('hmt_ros.nodes.')}
    assert {'filter_node', 'smoother_node', 'person_node', 'camera_node'} <= nodes
    commands = {name: f'{module}:main' for name, (module, _) in COMMANDS.items()}
    assert {name: points[name] for name in points.keys() - nodes} == commands
    for line in lines:
        module, _, function = line.split('=')[1].strip().partition(':')
        tree = ast.parse(MODULES[module].read_text('utf-8'))
        assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


@pytest.mark.filterwarnings('ignore:.*traverse:DeprecationWarning')
@pytest.mark.parametrize('folder', [ROOT, HMT_MSGS], ids=['hmt_ros', 'hmt_msgs'])
def test_changelog_can_be_released(folder, tmp_path):
    changelog = pytest.importorskip('catkin_pkg.changelog')
    version = hmt_ros.__version__
    text = (folder / 'CHANGELOG.rst').read_text('utf-8')
    name = xml(folder / 'package.xml').findtext('name')
    assert text.splitlines()[1] == f'Changelog for package {name}'
    # Changes made by catkin_prepare_release to the section of forthcoming changes.
    released = text.replace(
        'Forthcoming\n-----------\n', f'{version} (2000-01-01)\n------------------\n'
    )
    path = tmp_path / 'CHANGELOG.rst'
    path.write_text(released, 'utf-8')
    parsed = changelog.get_changelog_from_path(str(path), name)
    assert len(parsed.get_content_of_version(version)) > 0


def test_a_wheel_has_the_library_and_one_command(tmp_path):
    sources = tmp_path / 'sources'
    for name in (
        *('hmt_ros', 'msg_tools', 'hmt_learning', 'resource'),
        *('launch', 'rviz', 'foxglove', 'security', 'LICENSES'),
    ):
        ignored = shutil.ignore_patterns('__pycache__', '*.so')
        shutil.copytree(ROOT / name, sources / name, ignore=ignored)
    for name in ('setup.py', 'setup.cfg', 'pyproject.toml', 'package.xml', 'LICENSE'):
        shutil.copy2(ROOT / name, sources)
    copy_objects_of_core(sources / 'build')
    pip = [sys.executable, '-m', 'pip']
    command = [*pip, 'wheel', '--no-deps', '--no-build-isolation', '--wheel-dir', tmp_path, sources]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    (path,) = tmp_path.glob('*.whl')
    # Installs into a new environment, which has the requirements but no compiler.
    venv = tmp_path / 'venv'
    subprocess.run([sys.executable, '-m', 'venv', '--without-pip', venv], check=True)
    alone = {'PATH': str(venv / 'bin')}
    command = [
        *pip,
        '--python',
        venv / 'bin' / 'python',
        'install',
        '--no-deps',
        '--no-index',
        path,
    ]
    subprocess.run(command, env=alone, capture_output=True, check=True)
    (site,) = venv.glob('lib/python*/site-packages')
    assert not (site / 'hmt_learning').exists()
    installed = {x.name for x in site.glob('*.dist-info/**/*')}
    assert {'LICENSE', *(x.name for x in (ROOT / 'LICENSES').iterdir())} <= installed
    (text,) = (x.read_text('utf-8') for x in site.glob('*.dist-info/entry_points.txt'))
    assert text.split() == ['[console_scripts]', 'hmt_ros', '=', 'hmt_ros.app:main']
    (site / 'requirements.pth').write_text(sysconfig.get_path('purelib'), 'utf-8')
    program = (
        'import sys\n'
        'for missing in ("rclpy", "hmt_msgs", "std_msgs", "sensor_msgs", "geometry_msgs"):\n'
        '    sys.modules[missing] = None\n'
        'from hmt_ros.app import COMMANDS, main\n'
        'from hmt_ros.body import load_body\n'
        'from hmt_ros.core import _compiled\n'
        'from msg_tools import typestore\n'
        'assert "hmt_msgs/msg/PoseMixture" in typestore().types\n'
        'for name in COMMANDS:\n'
        '    try:\n'
        '        main([name, "--help"])\n'
        '    except SystemExit as ended:\n'
        '        assert ended.code == 0, name\n'
        'body = load_body("human37")\n'
        'assert body.joint_positions(body.prior_mean[None]).shape[0] == 1\n'
        'print(load_body.__code__.co_filename, _compiled.__file__, file=sys.stderr)\n'
    )
    ran = subprocess.run(
        [venv / 'bin' / 'python', '-I', '-c', program],
        cwd=tmp_path, env=alone, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.count('usage: ') == len(COMMANDS)
    assert all(Path(where).is_relative_to(site) for where in ran.stderr.split())


def test_tests_that_begin_first_exist():
    assert [name for name in LONGEST if not (ROOT / 'test' / name).is_file()] == []


def test_a_release_is_refused_while_addresses_are_not_public(tmp_path):
    """In a temporary repository with the script and its input files."""
    files = ('package.xml', 'setup.py', 'examples/package.xml', 'msg_tools/hmt_msgs/package.xml')
    for name in (*files, 'tools/release.sh'):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)

    def refused():
        done = subprocess.run(
            [tmp_path / 'tools' / 'release.sh'], capture_output=True, text=True, check=False
        )
        assert done.returncode == 1
        assert not (tmp_path / 'build').exists()
        (line,) = done.stderr.splitlines()
        return line

    def git(*words):
        who = ('-c', 'user.name=a', '-c', 'user.email=a@b.c')
        subprocess.run(['git', '-C', tmp_path, *who, *words], check=True, capture_output=True)

    git('init')
    assert 'wanted a tree without changes' in refused()
    git('add', '-A')
    git('commit', '-m', 'all')
    assert refused().startswith(f'release: example.com stands for addresses in {" ".join(files)}')
