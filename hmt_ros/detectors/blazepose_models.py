"""The networks of MediaPipe Pose: files of the wheel of MediaPipe, under its Apache licence.

`install-detector` takes them from the wheel; MediaPipe itself, which needs numpy below 2, is not
installed. They lie in share/hmt_ros/blazepose of the Python environment or, where that can not be
written, of the user.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
import sysconfig
from pathlib import Path

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


class DetectorError(ValueError):
    """The detector is not installed; one line."""


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
