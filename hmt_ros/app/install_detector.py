"""install-detector: installs MediaPipe Pose for keypoints_node and import-video.

pip installs LiteRT, which runs its networks. The networks are taken from the wheel of MediaPipe,
which is not installed.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from hmt_ros.app.command_line import CommandParser, run_command
from hmt_ros.detectors.blazepose_models import (
    CHECKSUMS,
    RUNTIME,
    WHEEL,
    folders,
    has_networks,
    has_runtime,
)

# The networks are the same in the wheels of all platforms: one that every release of pip accepts.
_ANY_WHEEL = (
    *('--no-deps', '--only-binary=:all:', '--platform=manylinux_2_28_x86_64'),
    *('--python-version=3.12', '--implementation=cp', '--abi=cp312'),
)


def main(argv: list[str] | None = None) -> int:
    """Runs the command; 0: done, 1: bad input, which one line on stderr explains."""
    return run_command(_parser(), _install, argv)


def _parser() -> CommandParser:
    parser = CommandParser(
        'install-detector',
        f'Installs MediaPipe Pose for keypoints_node and import-video: {RUNTIME} with pip, and the '
        f'networks (9 MB) out of the wheel of {WHEEL}.',
    )
    parser.add_argument('--quiet', action='store_true', help='print only warnings and errors')
    return parser


def _install(arguments: argparse.Namespace) -> int:
    if not has_runtime():
        _pip('install', RUNTIME)
    if not has_networks():
        with tempfile.TemporaryDirectory() as downloads:
            _pip('download', *_ANY_WHEEL, f'--dest={downloads}', WHEEL)
            (wheel,) = Path(downloads).glob('*.whl')
            networks = networks_of(wheel)
        _write(networks)
    if not arguments.quiet:
        print('MediaPipe Pose is installed')
    return 0


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
        # A reader sees the whole file or none.
        unfinished = folder / f'{name}.part'
        unfinished.write_bytes(data)
        unfinished.replace(folder / name)


def _pip(*arguments: str) -> None:
    command = [sys.executable, '-m', 'pip', '-q', '--disable-pip-version-check', *arguments]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        lines = [line for line in done.stderr.splitlines() if line.strip()]
        faults = [line for line in lines if line.lower().startswith('error')] or lines[-1:]
        raise ValueError(f'"{" ".join(command)}" failed: {faults[-1] if faults else "no message"}')
