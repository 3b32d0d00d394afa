"""`install-detector`: what it asks pip for, takes from the wheel and writes, without a network."""

import hashlib
import subprocess
import sys
import types
import zipfile
from pathlib import Path

import pytest

from hmt_ros.app import install_detector
from hmt_ros.detectors import blazepose_models
from hmt_ros.detectors.blazepose_models import require_network
from hmt_ros.detectors.detector import DetectorError

CONTENT = {name: name.encode() for name in blazepose_models.CHECKSUMS}


class Pip:
    """Stands for pip: notes its arguments, and puts a wheel where a download is wanted."""

    def __init__(self):
        self.asked: list[list[str]] = []
        self.content = dict(CONTENT)
        self.fault = ''

    def __call__(self, command, **_):
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


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """Folder of the environment, and of the user; neither exists."""
    found = tmp_path / 'environment' / 'share', tmp_path / 'user' / 'share'
    monkeypatch.setattr(blazepose_models, 'folders', lambda: found)
    checksums = {name: hashlib.sha256(data).hexdigest() for name, data in CONTENT.items()}
    monkeypatch.setattr(blazepose_models, 'CHECKSUMS', checksums)
    return found


@pytest.fixture
def pip(folders, monkeypatch):
    stand_in = Pip()
    monkeypatch.setattr(subprocess, 'run', stand_in)
    # No runtime yet.
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
