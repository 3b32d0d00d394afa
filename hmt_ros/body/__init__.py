"""The person: skeleton, kinematics, flesh, priors, flips, and the camera that looks."""

from __future__ import annotations

from pathlib import Path

from hmt_ros.body.body import Body
from hmt_ros.body.camera import Camera
from hmt_ros.body.interpretation_tree import enumerate_flips
from hmt_ros.body.model_file import model_names, read_body
from hmt_ros.body.motion_file import SUFFIXES, read_skeleton

__all__ = ['Body', 'Camera', 'enumerate_flips', 'load_body', 'model_names', 'named_body']


def load_body(source: str | Path) -> Body:
    """The body of this name ('human37', 'human34', 'human32'), of a YAML file or of a motion file.

    A motion file (.bvh, .asf, .amc) gives the body of its own skeleton, without flesh.

    Raises:
        FileNotFoundError: neither a known name nor a file.
        ValueError: a file that is not a body; one line that says what is wrong.
    """
    if Path(source).suffix.lower() in SUFFIXES:
        return read_skeleton(source)
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
