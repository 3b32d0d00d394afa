import ast
import os
import re
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext
from setuptools.command.develop import develop
from setuptools.command.install import install

ROOT = Path(__file__).resolve().parent
PACKAGE = 'hmt_ros'
MESSAGES = 'hmt_msgs'


def files(folder: str, pattern: str) -> list[str]:
    """Files of a folder for setuptools, with paths relative to this file, in a fixed order."""
    return sorted(str(path.relative_to(ROOT)) for path in (ROOT / folder).glob(pattern))


def nodes() -> list[str]:
    """Entry points of the nodes: every file NAME_node.py of hmt_ros/nodes with a `main`."""
    paths = (ROOT / PACKAGE / 'nodes').glob('*_node.py')
    names = sorted(path.stem for path in paths if 'def main(' in path.read_text('utf-8'))
    return [f'{name} = {PACKAGE}.nodes.{name}:main' for name in names]


def commands() -> list[str]:
    """Entry points of the commands, from the table COMMANDS of hmt_ros/app, without importing."""
    module = ast.parse((ROOT / PACKAGE / 'app' / '__init__.py').read_text('utf-8'))
    assigned = [x for x in module.body if isinstance(x, ast.Assign)]
    (table,) = (x.value for x in assigned if ast.unparse(x.targets[0]) == 'COMMANDS')
    return [f'{name} = {found[0]}:main' for name, found in ast.literal_eval(table).items()]


# Whether pip builds a wheel (library and offline commands only); colcon does not build wheels.
WHEEL = not {'bdist_wheel', 'dist_info', 'editable_wheel'}.isdisjoint(sys.argv)


def opencv() -> list[str]:
    """OpenCV as a requirement of a wheel, unless the environment of pip already has it.

    All distributions of OpenCV (apt, opencv-python, -headless, -contrib) install the same module,
    so that a second distribution would overwrite the first.
    """
    if not WHEEL:
        return []
    # pip isolates its build environment with these variables; this looks at the user's environment.
    hidden = ('PYTHONPATH', 'PYTHONNOUSERSITE')
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    program = 'import importlib.util as u; raise SystemExit(u.find_spec("cv2") is None)'
    done = subprocess.run([sys.executable, '-c', program], env=environment, cwd='/', check=False)
    return ['opencv-python-headless'] if done.returncode else []


# Without fused multiply-add, every processor rounds in the same way. Without errno and traps, and
# with "omp simd", the compiler can vectorise loops.
CORE_OPTIONS = ['-std=c++20', '-O3', '-ffp-contract=off', '-fno-math-errno', '-fno-trapping-math']
CORE_OPTIONS += ['-fvisibility=hidden', '-fopenmp-simd']
# Requirements of the core: condition of the preprocessor, name of the requirement, apt package.
CORE_NEEDS = [
    ('__cplusplus >= 202002L', 'compiler for C++20 (g++ 11, clang++ 14 or later)', 'g++'),
    ('__has_include(<Python.h>)', 'Python.h', 'python3-dev'),
    ('__has_include(<pybind11/pybind11.h>)', 'pybind11', 'pybind11-dev'),
]


def core() -> Extension:
    """The extension module of the compiled core, from the sources in hmt_ros/core."""
    folder = f'{PACKAGE}/core'
    return Extension(
        f'{PACKAGE}.core._compiled',
        files(folder, '**/*.cpp'),
        depends=[*files(folder, '**/*.h'), 'setup.py'],
        extra_compile_args=CORE_OPTIONS,
        language='c++',
    )


class BuildCore(build_ext):
    """``build_ext`` that compiles files in parallel, and only files that have changed.

    The headers of pybind11 come from its Python package or from the system. ``--debug`` compiles
    for debuggers.
    """

    def build_extension(self, ext: Extension) -> None:
        """Compile and link the core."""
        with suppress(ImportError):
            from pybind11 import get_include

            self.compiler.add_include_dir(get_include())
        self.expect_compiler()
        ext.extra_compile_args += ['-Og', '-g'] if self.debug else ['-DNDEBUG', '-g0']
        compile_all, compile_one = self.compiler.compile, self.compiler._compile

        def compile_together(*arguments: Any, **options: Any) -> list[str]:
            begun = []

            def begin(target: str, source: str, *rest: Any) -> None:
                if self.force or is_older(target, [source, *ext.depends]):
                    begun.append(pool.submit(compile_one, target, source, *rest))

            self.compiler._compile = begin
            with ThreadPoolExecutor(processes()) as pool:
                objects = compile_all(*arguments, **options)
            for one in begun:
                one.result()
            return objects

        self.compiler.compile = compile_together
        super().build_extension(ext)

    def expect_compiler(self) -> None:
        """Exit with a one-line error if a requirement of the core is missing."""
        # Older versions of setuptools compile C++ with the command of the C compiler.
        compiler = getattr(self.compiler, 'compiler_so_cxx', self.compiler.compiler_so)
        folders = [f'-I{folder}' for folder in self.compiler.include_dirs]
        command = [*compiler, *folders, CORE_OPTIONS[0], '-E', '-P', '-x', 'c++', '-']
        asked = [f'#if {x[0]}\nfound {i}\n#endif\n' for i, x in enumerate(CORE_NEEDS)]
        try:
            done = subprocess.run(
                command, input=''.join(asked), capture_output=True, text=True, check=False
            )
            found = done.stdout
        except OSError:
            found = ''
        for i, (_, name, package) in enumerate(CORE_NEEDS):
            if f'found {i}' not in found:
                raise SystemExit(
                    f'{PACKAGE}: no {name} to compile its core with {compiler[0]}. '
                    f'Try: sudo apt install {package}'
                )


def is_older(target: str, sources: list[str]) -> bool:
    """Whether a file is missing, or older than one of its sources."""
    made = Path(target).stat().st_mtime if Path(target).is_file() else -1.0
    return any(Path(source).stat().st_mtime > made for source in sources)


def processes() -> int:
    """Number of parallel compilations: from MAKEFLAGS or, without it, one per processor."""
    found = re.search(r'-j ?(\d+)', os.environ.get('MAKEFLAGS', ''))
    return int(found[1]) if found else os.cpu_count() or 1


class Install(install):
    """``install`` that also installs the messages, into the prefix given by colcon or bloom."""

    def finalize_options(self) -> None:
        """Record whether a prefix was given, before the default is filled in."""
        self.prefix_is_given = self.prefix is not None
        super().finalize_options()

    def run(self) -> None:
        """Install hmt_msgs, then hmt_ros."""
        prefix = Path(self.install_base)
        given = self.prefix_is_given and 'AMENT_PREFIX_PATH' in os.environ and not WHEEL
        if given or in_colcon(prefix):
            build_base = Path(self.get_finalized_command('build').build_base)
            install_messages(build_base / MESSAGES, prefix, str(self.root or ''))
        super().run()


class Develop(develop):
    """``develop`` that also installs the messages, for ``colcon build --symlink-install``."""

    def run(self) -> None:
        """Install hmt_msgs, then hmt_ros."""
        prefix = Path(self.prefix or sys.prefix)
        if in_colcon(prefix):
            build_base = Path(self.get_finalized_command('build').build_base)
            install_messages(build_base / MESSAGES, prefix, '')
        super().run()


def in_colcon(prefix: Path) -> bool:
    """Whether colcon installs into this folder, either isolated or merged with other packages."""
    return not WHEEL and any(
        (x / '.colcon_install_layout').is_file() for x in (prefix, prefix.parent)
    )


def install_messages(build: Path, prefix: Path, root: str) -> None:
    """Build and install hmt_msgs, unless the ROS environment has it with the same definitions.

    colcon and bloom do not look for packages inside a package, so they find only hmt_ros.

    Args:
        build: Folder for the files of CMake.
        prefix: Installation folder, with the path that it has when the package is used.
        root: Folder that replaces ``/`` while a Debian package is built; empty: no replacement.
    """
    built_before = (build / 'CMakeCache.txt').is_file()
    if not built_before and messages_are_there():
        return
    if not os.environ.get('AMENT_PREFIX_PATH'):
        raise SystemExit(
            f'{MESSAGES}: no ROS environment, AMENT_PREFIX_PATH is not set. Run "source '
            '/opt/ros/jazzy/setup.bash" and then the same command'
        )
    environment = dict(os.environ, DESTDIR=root)
    # Like colcon for CMake packages: uses all processors, unless the user sets a number.
    if 'MAKEFLAGS' not in environment:
        environment.setdefault('CMAKE_BUILD_PARALLEL_LEVEL', str(os.cpu_count() or 1))
    # colcon adds folders for setup.py that change sys.prefix, which CMake would read.
    folders = environment.get('PYTHONPATH', '').split(os.pathsep)
    ours = ('prefix_override', 'colcon_distutils_commands')
    environment['PYTHONPATH'] = os.pathsep.join(x for x in folders if Path(x).name not in ours)
    ros = [os.environ.get(x, '') for x in ('AMENT_PREFIX_PATH', 'CMAKE_PREFIX_PATH')]
    environment['CMAKE_PREFIX_PATH'] = os.pathsep.join(filter(None, ros))
    settings = [f'-DCMAKE_INSTALL_PREFIX={prefix}', '-DBUILD_TESTING=OFF']
    settings += shlex.split(os.environ.get('CMAKE_ARGS', ''))
    steps = [
        ['cmake', '-S', str(ROOT / 'msg_tools' / MESSAGES), '-B', str(build), *settings],
        ['cmake', '--build', str(build)],
        ['cmake', '--install', str(build)],
    ]
    for step in steps:
        try:
            done = subprocess.run(step, env=environment, check=False)
        except FileNotFoundError:
            raise SystemExit(f'{MESSAGES}: no cmake in PATH. Try: sudo apt install cmake') from None
        if done.returncode != 0:
            raise SystemExit(
                f'{MESSAGES} could not be built, see above: "{shlex.join(step)}" ended with '
                f'{done.returncode}. Was /opt/ros/jazzy/setup.bash sourced, and "rosdep install '
                '--from-paths src" run?'
            )


def messages_are_there() -> bool:
    """Whether the first hmt_msgs of the ROS environment has the definitions of this repository."""
    prefixes = os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep)
    shares = [Path(prefix, 'share', MESSAGES) for prefix in prefixes if prefix]
    share = next((path for path in shares if path.is_dir()), None)
    own = ROOT / 'msg_tools' / MESSAGES
    definitions = [*own.glob('msg/*.msg'), *own.glob('srv/*.srv'), own / 'package.xml']
    return share is not None and all(
        (share / path.relative_to(own)).is_file()
        and (share / path.relative_to(own)).read_bytes() == path.read_bytes()
        for path in definitions
    )


setup(
    name=PACKAGE,
    version='1.0.0',
    description='Monocular 3D human motion tracking with mixtures, for ROS 2',
    license='Apache-2.0',
    license_files=['LICENSE', 'LICENSES/*'],
    author='hmt_ros contributors',
    url='https://example.com/hmt_ros',  # placeholder, as in package.xml
    maintainer='hmt_ros maintainers',
    maintainer_email='hmt-ros@example.com',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*', 'msg_tools', 'msg_tools.*']),
    package_data={
        PACKAGE: [
            'config/*.yaml',
            'config/*.xml',
            'body/models/*.yaml',
            'body/models/*.npz',
            'experts/models/*.npz',
            'image/*.yaml',
            'app/report/page/*',
        ],
        # Tools for bags read the message definitions without ROS.
        'msg_tools': ['hmt_msgs/msg/*.msg', 'hmt_msgs/srv/*.srv'],
    },
    data_files=[
        (target, sources)
        for target, sources in (
            ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
            (f'share/{PACKAGE}', ['package.xml', *files('.', 'LICENSE')]),
            (f'share/{PACKAGE}/LICENSES', files('LICENSES', '*')),
            (f'share/{PACKAGE}/config', files(f'{PACKAGE}/config', '*.*ml')),
            (f'share/{PACKAGE}/launch', files('launch', '*.launch.*')),
            (f'share/{PACKAGE}/rviz', files('rviz', '*.rviz')),
            (f'share/{PACKAGE}/foxglove', files('foxglove', '*.json')),
            (f'share/{PACKAGE}/security', files('security', '*.xml')),
        )
        if sources
    ],
    python_requires='>=3.10',
    install_requires=[
        'setuptools',
        'numpy',
        'scipy',
        'PyYAML',
        'matplotlib',
        'pillow',
        'lz4',
        'mcap',
        'rosbags',
        'tqdm',
        'zstandard',
        'tomli; python_version < "3.11"',
        *opencv(),
    ],
    extras_require={
        'test': ['pytest', 'hypothesis'],
        'dask': ['distributed'],
        # Additional requirements of hmt_learning, which is not installed itself.
        'learning': ['jax', 'optax'],
        'detector': ['ai-edge-litert'],
        'video': ['av'],
    },
    zip_safe=False,
    ext_modules=[core()],
    cmdclass={'build_ext': BuildCore, 'install': Install, 'develop': Develop},
    entry_points={
        # "ros2 run" finds each program by its name; pip would put all of them into PATH.
        'console_scripts': [f'{PACKAGE} = {PACKAGE}.app:main']
        if WHEEL
        else [*nodes(), *commands()],
    },
)
