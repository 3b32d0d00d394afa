"""The clone as one of several packages: in a colcon workspace, for rosdep, for bloom."""

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from types import SimpleNamespace

import pytest
import setuptools
import yaml

from test.conftest import copy_objects_of_core

ROOT = Path(__file__).resolve().parents[1]
HMT_MSGS = ROOT / 'msg_tools' / 'hmt_msgs'
EXAMPLES = ROOT / 'examples'
PARTS = ['colcon.pkg', 'package.xml', 'setup.py', 'setup.cfg', 'resource', 'hmt_ros', 'msg_tools']
PARTS += ['launch', 'rviz', 'foxglove', 'security', 'examples']
IGNORED = shutil.ignore_patterns('__pycache__', '*.so')

PAGE = (ROOT / 'docs' / 'consumers.md').read_text('utf-8')
RCLCPP = ROOT / 'test' / 'rclcpp_stand_in'


def code(language):
    """The only block of code in a language on the page on consumers."""
    (found,) = re.findall(rf'^```{language}\n(.*?)^```$', PAGE, re.M | re.S)
    return found


def package_xml(name, build_type, depends):
    return f"""<package format="3">
  <name>{name}</name><version>0.0.0</version><description>Uses hmt_msgs.</description>
  <maintainer email="somebody@example.com">somebody</maintainer><license>Apache-2.0</license>
  {depends}
  <export><build_type>{build_type}</build_type></export>
</package>
"""


# Packages of the same workspace that use the messages as in docs/consumers.md; one is before
# hmt_ros in the alphabet, and one after it.
CONSUMERS = {
    'consumer/package.xml': package_xml('consumer', 'ament_cmake', code('xml')),
    'consumer/CMakeLists.txt': code('cmake'),
    'consumer/consumer.cpp': (EXAMPLES / 'stop_near_hand.cpp').read_text('utf-8'),
    'listener/package.xml': package_xml('listener', 'ament_python', code('xml')),
    'listener/setup.py': """from setuptools import setup
setup(
    name='listener', packages=['listener'],
    data_files=[('share/ament_index/resource_index/packages', ['resource/listener']),
                ('share/listener', ['package.xml'])],
    entry_points={'console_scripts': ['listener = listener.node:main']},
)
""",
    'listener/setup.cfg': """[develop]
script_dir=$base/lib/listener
[install]
install_scripts=$base/lib/listener
""",
    'listener/resource/listener': '',
    'listener/listener/__init__.py': '',
    'listener/listener/node.py': code('py'),
}


def ros_without_this_package():
    """The environment of the tests, without the workspace of their build."""
    environment = dict(os.environ)
    prefixes = [Path(x) for x in os.environ['AMENT_PREFIX_PATH'].split(os.pathsep) if x]
    own = [x for x in prefixes if any((x / 'share' / n).is_dir() for n in ('hmt_ros', 'hmt_msgs'))]
    own.append(ROOT)
    for name in ('AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH', 'PYTHONPATH', 'LD_LIBRARY_PATH'):
        folders = [Path(x) for x in environment.get(name, '').split(os.pathsep) if x]
        venv = Path(sys.prefix).resolve()  # .venv may be a link
        kept = [
            x for x in folders if x.resolve() == venv or not any(x.is_relative_to(y) for y in own)
        ]
        environment[name] = os.pathsep.join(map(str, kept))
    # Folders of libraries in wheels, which are not found from a C++ program otherwise.
    libraries = map(str, Path(sysconfig.get_path('purelib')).glob('ros_*.libs'))
    environment['LD_LIBRARY_PATH'] += ''.join(f':{folder}' for folder in sorted(libraries))
    environment.pop('COLCON_PREFIX_PATH', None)
    environment.pop('_ROS_WHEELS_BOOTSTRAP_COMPLETE', None)
    # Python headers unpacked by tools/workspace.sh.
    headers = Path(sys.prefix, 'python-headers')
    if headers.is_dir():
        include = f'{headers}{sysconfig.get_path("include")}'
        environment['CMAKE_ARGS'] = f'-DPython3_INCLUDE_DIR={include}'
        environment['CPATH'] = str(headers / 'usr' / 'include')
    return environment


def write_packages(folder, replace=('', '')):
    """Writes the packages that use the messages, with one text replaced."""
    for name, text in CONSUMERS.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text.replace(*replace) if replace[0] else text, 'utf-8')


@pytest.fixture(scope='module')
def workspace(tmp_path_factory):
    """A workspace with the clone in src/, after "colcon build"."""
    if shutil.which('colcon') is None:
        pytest.skip('colcon is not installed: a workspace cannot be built')
    folder = tmp_path_factory.mktemp('workspace')
    for part in PARTS:
        target = folder / 'src' / 'hmt_ros' / part
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, target, ignore=IGNORED)
        else:
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / part, target)
    write_packages(folder / 'src')
    copy_objects_of_core(folder / 'build' / 'hmt_ros' / 'build')
    environment = ros_without_this_package()
    # The stand-in precedes an installed rclcpp, and answers without a publisher.
    environment['CMAKE_PREFIX_PATH'] = f'{RCLCPP}:{environment["CMAKE_PREFIX_PATH"]}'
    # The command line on the page of the examples.
    page = (EXAMPLES / 'README.md').read_text('utf-8')
    (line,) = re.findall(r'^colcon build .*$', page, re.M)
    done = subprocess.run(
        line.split(),
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'Summary: 4 packages finished' in done.stdout
    return folder


def sourced(workspace, command):
    """A command in a shell that has sourced the workspace."""
    return subprocess.run(
        ['bash', '-c', f'source {workspace}/install/setup.bash && {command}'],
        cwd=workspace,
        env=ros_without_this_package(),
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )


@pytest.mark.ros
def test_colcon_build_in_a_workspace_builds_the_messages(workspace):
    program = (
        'import hmt_ros.core, json, sys; from hmt_msgs.msg import PoseComponent, PoseMixture; '
        'from rclpy.serialization import deserialize_message, serialize_message; '
        'sent = PoseMixture(components=[PoseComponent(weight=0.25)]); '
        'got = deserialize_message(serialize_message(sent), PoseMixture); '
        'json.dump([hmt_ros.core._compiled.__file__, got.components[0].weight], sys.stdout)'
    )
    done = sourced(workspace, f"python3 -c '{program}'")
    assert done.returncode == 0, done.stderr
    path, weight = json.loads(done.stdout)
    assert Path(path).is_relative_to(workspace / 'install')
    assert weight == 0.25
    share = workspace / 'install' / 'hmt_ros' / 'share' / 'hmt_msgs'
    for path in (*HMT_MSGS.glob('msg/*.msg'), *HMT_MSGS.glob('srv/*.srv')):
        assert (share / path.relative_to(HMT_MSGS)).read_bytes() == path.read_bytes()


@pytest.mark.ros
def test_packages_that_use_the_messages_run(workspace):
    for package, name in (('consumer', 'consumer'), ('hmt_ros_examples', 'stop_near_hand')):
        ran = sourced(workspace, f'install/{package}/lib/{package}/{name}')
        # It stops before any message, for a hand that may be near, for a lost person, and for
        # three mixtures without information on hands.
        assert (ran.returncode, ran.stdout) == (0, '101010111'), ran.stderr
    programs = workspace / 'install' / 'hmt_ros_examples' / 'lib' / 'hmt_ros_examples'
    for path in EXAMPLES.glob('*.py'):
        assert os.access(programs / path.name, os.X_OK), path.name
    program = 'from importlib.metadata import entry_points as found; '
    program += '(one,) = found(group="console_scripts", name="listener"); '
    program += 'print(one.load().__module__)'
    ran = sourced(workspace, f"python3 -c '{program}'")
    assert (ran.returncode, ran.stdout) == (0, 'listener.node\n'), ran.stderr


@pytest.mark.ros
def test_a_node_of_a_workspace_starts(workspace):
    node = subprocess.Popen(
        ['bash', '-c', 'source install/setup.bash && exec install/hmt_ros/lib/hmt_ros/filter_node'],
        cwd=workspace,
        env=ros_without_this_package(),
        stderr=subprocess.PIPE,
        text=True,
    )
    assert node.stderr is not None
    first = node.stderr.readline()
    node.terminate()
    rest = node.communicate(timeout=60)[1]
    assert 'images from /image' in first, first + rest
    assert node.returncode == 0


# ---- Messages in setup.py, without building them ----


@pytest.fixture
def install_messages(monkeypatch, tmp_path):
    """setup.py's functions; commands of CMake are recorded instead of run."""
    calls: list[tuple[list[str], dict[str, str]]] = []
    codes: list[int] = []

    def run(command, *, env, check):
        calls.append((command, env))
        return SimpleNamespace(returncode=codes.pop() if codes else 0)

    monkeypatch.setattr(setuptools, 'setup', lambda **_: None)
    names = runpy.run_path(str(ROOT / 'setup.py'))
    monkeypatch.setattr(names['subprocess'], 'run', run)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path / 'ros'))
    return SimpleNamespace(calls=calls, codes=codes, **names)


def install_definitions(prefix):
    share = prefix / 'share' / 'hmt_msgs'
    for name in ('msg', 'srv'):
        shutil.copytree(HMT_MSGS / name, share / name)
    shutil.copy(HMT_MSGS / 'package.xml', share)
    return share


def test_messages_with_other_definitions_are_built(install_messages, tmp_path):
    share = install_definitions(tmp_path / 'ros')
    (share / 'msg' / 'Body.msg').write_text('string name\n', 'utf-8')
    install_messages.install_messages(tmp_path / 'build', tmp_path / 'install', '')
    (configure, environment), (compile_, _), (install, _) = install_messages.calls
    assert configure[:4] == ['cmake', '-S', str(HMT_MSGS), '-B']
    assert f'-DCMAKE_INSTALL_PREFIX={tmp_path / "install"}' in configure
    assert [compile_[1], install[1]] == ['--build', '--install']
    assert environment['DESTDIR'] == ''


def test_a_failed_build_of_messages_says_what_to_do(install_messages, tmp_path):
    install_messages.codes.append(1)
    with pytest.raises(SystemExit, match='rosdep install') as raised:
        install_messages.install_messages(tmp_path / 'build', tmp_path / 'install', '')
    assert len(str(raised.value).splitlines()) == 1
    assert len(install_messages.calls) == 1


# ---- The detector in tools/workspace.sh, with a stand-in for Python ----


@pytest.fixture
def clone(tmp_path):
    """The files of a clone that the detector stage reads, without the packages."""
    for name in (
        'tools/workspace.sh',
        'requirements/detector.txt',
        'hmt_ros/detectors/blazepose_models.py',
    ):
        target = tmp_path / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, target)
    stamps, python = tmp_path / '.venv' / 'stamps', tmp_path / '.venv' / 'bin' / 'python'
    stamps.mkdir(parents=True)
    (stamps / 'ros').write_text('as it is\n', 'utf-8')
    python.parent.mkdir()
    # Records its arguments, and fails for those named in the file "offline".
    python.write_text(
        f'#!/bin/bash\necho "$*" >>{tmp_path}/calls\n'
        f'if [ -f {tmp_path}/offline ] && [[ "$*" == *"$(cat {tmp_path}/offline)"* ]]; then\n'
        '  echo WARNING: connection broken >&2\n'
        '  echo ERROR: no route to host >&2\n  exit 1\nfi\n',
        'utf-8',
    )
    python.chmod(0o755)
    return tmp_path


def run_detector_stage(clone):
    """Exit code, lines on stderr without times, and Python calls of one run."""
    (clone / 'calls').unlink(missing_ok=True)
    done = subprocess.run(
        [clone / 'tools' / 'workspace.sh', 'detector'], capture_output=True, text=True, check=False
    )
    assert done.stdout == ''
    calls = clone / 'calls'
    count = len(calls.read_text('utf-8').splitlines()) if calls.exists() else 0
    lines = [x for x in done.stderr.splitlines() if not x.endswith(' s so far')]
    return done.returncode, lines, count


def test_the_detector_is_installed_once(clone):
    assert run_detector_stage(clone) == (0, ['hmt_ros: installing MediaPipe Pose'], 2)
    pip, networks = (
        ' -m pip -qq --disable-pip-version-check --no-input install --no-compile --retries 1 '
        '-r requirements/detector.txt',
        '-m hmt_ros install-detector --quiet',
    )
    run_detector_stage(clone)
    (clone / '.venv' / 'stamps' / 'detector').unlink()
    run_detector_stage(clone)
    assert (clone / 'calls').read_text('utf-8').splitlines() == [pip.strip(), networks]
    assert run_detector_stage(clone) == (0, [], 0)
    # Another release of MediaPipe is fetched.
    with (clone / 'hmt_ros' / 'detectors' / 'blazepose_models.py').open('a') as file:
        file.write('# other networks\n')
    assert run_detector_stage(clone)[2] == 2


@pytest.mark.parametrize(('what', 'calls'), [('pip', 1), ('install-detector', 2)])
def test_without_network_the_rest_goes_on(clone, what, calls):
    (clone / 'offline').write_text(what, 'utf-8')
    code, (begun, told), count = run_detector_stage(clone)
    assert (code, begun, count) == (78, 'hmt_ros: installing MediaPipe Pose', calls)
    assert told == (
        'hmt_ros: MediaPipe Pose could not be installed, all else works without: "make detector" '
        'tries again (ERROR: no route to host)'
    )
    # Nothing has changed for other stages; the next call tries again.
    assert sorted(x.name for x in (clone / '.venv' / 'stamps').iterdir()) == ['ros']
    assert not (clone / '.venv' / 'unfinished').exists()
    (clone / 'offline').unlink()
    assert run_detector_stage(clone)[::2] == (0, 2)


# ---- Files for colcon, rosdep and bloom ----


def test_rosdep_can_resolve_what_it_finds():
    """rosdep finds one package here, and resolves no package of this repository."""
    packages = pytest.importorskip('catkin_pkg.packages')
    found = packages.find_packages(str(ROOT))
    assert [package.name for package in found.values()] == ['hmt_ros']
    (package,) = found.values()
    package.validate()
    kinds = ('buildtool', 'build', 'build_export', 'exec', 'test')
    names = {x.name for kind in kinds for x in getattr(package, f'{kind}_depends')}
    assert names.isdisjoint({'hmt_ros', 'hmt_msgs'})
    # It also installs the dependencies of the messages.
    messages = pytest.importorskip('catkin_pkg.package').parse_package(str(HMT_MSGS))
    messages.validate()
    needed = {x.name for kind in kinds for x in getattr(messages, f'{kind}_depends')}
    assert needed <= names


def order(folder, *options):
    """Names of packages in the order in which colcon builds them."""
    if shutil.which('colcon') is None:
        pytest.skip('colcon is not installed')
    command = ['colcon', 'list', '--topological-order', '--names-only', *options]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_messages_alone_are_linked_into_a_workspace(tmp_path):
    """The lines of docs/workspace.md, with the clone beside the workspace."""
    text = (ROOT / 'docs' / 'workspace.md').read_text('utf-8')
    (line,) = re.findall(r'^ln -s .*$', text, re.M)
    (depend,) = re.findall(r'`(<depend>hmt_msgs</depend>)`', text)
    folder = tmp_path / 'workspace'
    write_packages(folder / 'src', (code('xml').strip(), depend))
    (tmp_path / 'hmt_ros').symlink_to(ROOT)
    home = {**os.environ, 'HOME': str(tmp_path)}
    subprocess.run(['bash', '-c', line], cwd=folder, env=home, check=True)
    assert order(folder) == ['hmt_msgs', 'consumer', 'listener']


# ---- A file that is not run here, but its commands are ----


def test_workflow_runs_what_the_project_is_tested_with():
    workflow = yaml.safe_load((ROOT / '.github' / 'workflows' / 'ci.yml').read_text('utf-8'))
    job, nightly = workflow['jobs'].values()
    assert job['strategy']['matrix']['python'] == ['3.10', '3.11', '3.12', '3.13']
    assert 'CPython 3.10 to 3.13' in (ROOT / 'README.md').read_text('utf-8')
    runs = [[x['run'] for x in one['steps'] if 'run' in x] for one in (job, nightly)]
    assert runs == [['PYTHON=$(command -v python) .ci/run'], ['make sanitize']]
    assert os.access(ROOT / '.ci' / 'run', os.X_OK)
    assert re.search(r'^sanitize:', (ROOT / 'Makefile').read_text('utf-8'), re.M)
