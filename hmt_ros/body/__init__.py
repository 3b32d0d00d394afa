"""The person: skeleton, kinematics, flesh, limits, priors, and the camera that looks."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.model_file import model_names, read_body

__all__ = ['Body', 'Camera', 'load_body', 'model_names', 'named_body']

MOTION_FILES = ('.bvh', '.asf', '.amc')


def load_body(source: str | Path) -> Body:
    """The body of this name ('human37', 'human34', 'human32'), of a YAML file or of a motion file.

    A motion file (.bvh, .asf, .amc) gives the body of its own skeleton, without flesh.

    Raises:
        FileNotFoundError: neither a known name nor a file.
        ValueError: a file that is not a body; one line that says what is wrong.
    """
    if Path(source).suffix.lower() in MOTION_FILES:
        # Motion files are read a layer above; this package names them only where one is given.
        body: Body = importlib.import_module('hmt_ros.motion.motion_file').read_skeleton(source)
        return body
    return read_body(source)


def named_body(name: str) -> Body:
    """The body that ships under a name; for names in messages, which must not lead to files.

    Raises:
        FileNotFoundError: none ships under this name.
    """
    known = model_names()
    if name not in known:
        raise FileNotFoundError(f'no body {name!r}: wanted one of {known}')
    return read_body(name)


def __getattr__(name: str) -> Any:
    """`enumerate_flips` lives in `hmt_ros.flips`; the name here is kept for its callers."""
    if name == 'enumerate_flips':
        return importlib.import_module('hmt_ros.flips').enumerate_flips
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
