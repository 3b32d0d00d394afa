"""The networks of MediaPipe Pose: files of the wheel of MediaPipe, under its Apache licence.

`install` takes them from the wheel; MediaPipe itself, which needs numpy below 2, is not installed.
They lie in share/hmt_ros/blazepose of the Python environment or, where that can not be
written, of the user.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import subprocess
import sys
import sysconfig
import tempfile
import zipfile
from pathlib import Path

from hmt_ros.detectors.detector import DetectorError
from msg_tools.files.new_folder import new_file

# Package that runs the networks, and the module that it brings.
RUNTIME, RUNTIME_MODULE = 'ai-edge-litert', 'ai_edge_litert'
# Release of MediaPipe whose wheel has the networks.
WHEEL = 'mediapipe==0.10.21'
PERSON = 'pose_detection.tflite'
LANDMARKS = 'pose_landmark_full.tflite'
# SHA-256 of each.
CHECKSUMS = {
    PERSON: '9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c',
    LANDMARKS: 'e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f',
}

# The networks are the same in the wheels of all platforms: one that every release of pip accepts.
_ANY_WHEEL = (
    *('--no-deps', '--only-binary=:all:', '--platform=manylinux_2_28_x86_64'),
    *('--python-version=3.12', '--implementation=cp', '--abi=cp312'),
)


def folders() -> tuple[Path, Path]:
    """Where the networks are sought: in the folder of the environment, then in the user's."""
    user = sysconfig.get_path('data', sysconfig.get_preferred_scheme('user'))
    environment, own = (
        Path(data, 'share', 'hmt_ros', 'blazepose') for data in (sysconfig.get_path('data'), user)
    )
    return environment, own


def network(name: str) -> bytes | None:
    """Content of a network's file; None where there is none, or another one."""
    for folder in folders():
        path = folder / name
        if path.is_file():
            data = path.read_bytes()
            if hashlib.sha256(data).hexdigest() == CHECKSUMS[name]:
                return data
    return None


def has_networks() -> bool:
    """Whether all networks are there."""
    return all(network(name) is not None for name in CHECKSUMS)


def has_runtime() -> bool:
    """Whether this Python has the package that runs them."""
    return importlib.util.find_spec(RUNTIME_MODULE) is not None


def is_installed() -> bool:
    """Whether the detector can run."""
    return has_runtime() and has_networks()


def require_network(name: str) -> bytes:
    """Content of a network's file.

    Raises:
        DetectorError: the detector is not installed.
    """
    data = network(name)
    if data is not None and has_runtime():
        return data
    if has_runtime():
        reason = f'no {name} as of {WHEEL} in {" or ".join(map(str, folders()))}'
    else:
        reason = f'{sys.executable} has no {RUNTIME}'
    raise DetectorError(
        f'MediaPipe Pose is not installed, {reason}: run "ros2 run hmt_ros install-detector", or '
        '"make detector" in a clone'
    )


def install() -> None:
    """Installs LiteRT with pip, and takes the networks out of the wheel of MediaPipe.

    Raises:
        ValueError: pip fails, or the wheel has other networks; one line.
    """
    if not has_runtime():
        _pip('install', RUNTIME)
    if not has_networks():
        with tempfile.TemporaryDirectory() as downloads:
            _pip('download', *_ANY_WHEEL, f'--dest={downloads}', WHEEL)
            (wheel,) = Path(downloads).glob('*.whl')
            networks = networks_of(wheel)
        _write(networks)


def networks_of(wheel: Path) -> dict[str, bytes]:
    """The networks in a wheel of MediaPipe, by name.

    Raises:
        ValueError: the wheel lacks one, or has another.
    """
    networks = {}
    with zipfile.ZipFile(wheel) as archive:
        members = {Path(member).name: member for member in archive.namelist()}
        for name, checksum in CHECKSUMS.items():
            data = archive.read(members[name]) if name in members else b''
            seen = hashlib.sha256(data).hexdigest()
            if seen != checksum:
                saw = f'one with SHA-256 {seen}' if data else 'none'
                raise ValueError(f'{wheel.name}: wanted {name} with SHA-256 {checksum}, saw {saw}')
            networks[name] = data
    return networks


def _write(networks: dict[str, bytes]) -> None:
    """Writes files for all users of this Python or, where that is not allowed, for this one."""
    everybody, own = folders()
    try:
        everybody.mkdir(parents=True, exist_ok=True)
        folder = everybody if os.access(everybody, os.W_OK) else own
    except PermissionError:
        folder = own
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in networks.items():
        with new_file(folder / name) as file:
            file.write(data)


def _pip(*arguments: str) -> None:
    command = [sys.executable, '-m', 'pip', '-q', '--disable-pip-version-check', *arguments]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        faults = [line for line in lines if line.lower().startswith('error')] or lines[-1:]
        raise ValueError(f'"{" ".join(command)}" failed: {faults[-1] if faults else "no message"}')
