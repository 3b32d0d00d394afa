"""Subject files: a person's joints in one image, and measurements of the person's size."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hmt_ros.body.body import Body
from hmt_ros.body.model_file import MAX_FILE_BYTES
from hmt_ros.image.terms.keypoints import Keypoints
from msg_tools.files.plain_yaml import read_plain_yaml

MAX_PIXEL = 1e5
MAX_LENGTH = 3.0  # m
KEYS = ('stamp_ns', 'sigma_px', 'keypoints', 'segment_lengths_m', 'stature_m')


class SubjectError(ValueError):
    """A subject file is invalid; the one-line message gives actual and expected content."""


@dataclass(frozen=True)
class Subject:
    """Content of a subject file, from which a track can start.

    Attributes:
        stamp_ns: stamp of the image in which the joints were seen, ns.
        keypoints: keypoints at the person's joints.
        segment_lengths: measured lengths by name, m.
        stature: height of the person, m; None if unknown.
    """

    stamp_ns: int
    keypoints: Keypoints
    segment_lengths: dict[str, float]
    stature: float | None = None


def read_subject(path: str | Path, body: Body) -> Subject:
    """Reads a subject file and checks its names against a body.

    The file is YAML: `stamp_ns`, `sigma_px`, `keypoints` (name: [u, v], px), and optionally
    `segment_lengths_m` (name: length) and `stature_m`.

    Raises:
        SubjectError: the file is missing, is not YAML, lacks an entry, or names a joint or a length
            that the body does not have.
    """
    try:
        return parse_subject(read_plain_yaml(path, MAX_FILE_BYTES), body)
    except ValueError as fault:
        raise SubjectError(f'{path}: {fault}') from fault


def parse_subject(content: Any, body: Body) -> Subject:
    """Makes the subject from the content of a subject file.

    Raises:
        SubjectError: as for `read_subject`, except missing files.
    """
    if not isinstance(content, dict):
        raise SubjectError(f'wanted entries {list(KEYS)}, saw {type(content).__name__}')
    unknown = sorted(str(k) for k in content if k not in KEYS)
    if unknown:
        raise SubjectError(f'unknown entries {unknown}, known are {list(KEYS)}')
    for key in ('stamp_ns', 'keypoints'):
        if key not in content:
            raise SubjectError(f'no entry {key!r}')
    stamp = content['stamp_ns']
    if not isinstance(stamp, int) or isinstance(stamp, bool) or stamp < 0:
        raise SubjectError(f'stamp_ns must be a whole number of nanoseconds, saw {stamp!r}')
    sigma = _positive(content.get('sigma_px', 3.0), 'sigma_px')
    clicked = content['keypoints']
    if not isinstance(clicked, dict) or len(clicked) < 4:
        raise SubjectError('keypoints must name at least four joints')
    _check_names(clicked, body.joint_names, 'joint', body.name)
    pixels = np.array([_pixel(name, value) for name, value in clicked.items()])
    n = len(clicked)
    keypoints = Keypoints(
        tuple(clicked), pixels, np.tile(sigma**2 * np.eye(2), (n, 1, 1)), np.ones(n)
    )
    lengths = content.get('segment_lengths_m') or {}
    if not isinstance(lengths, dict):
        raise SubjectError(f'segment_lengths_m must map names to metres, saw {lengths!r}')
    _check_names(lengths, body.skeleton.length_names, 'length', body.name)
    deviations = np.sqrt(np.diag(body.length_covariance))
    signed = dict(zip(body.skeleton.length_names, deviations > body.skeleton.lengths))
    checked = {name: _length(value, name, signed[name]) for name, value in lengths.items()}
    stature = content.get('stature_m')
    if stature is not None:
        stature = _positive(stature, 'stature_m', MAX_LENGTH)
    return Subject(stamp, keypoints, checked, stature)


def _check_names(given: dict[Any, Any], known: tuple[str, ...], kind: str, body: str) -> None:
    wrong = sorted(str(name) for name in given if name not in known)
    if wrong:
        raise SubjectError(f'{body} has no {kind} {wrong}; it has {sorted(known)}')


def _positive(value: Any, name: str, largest: float = MAX_PIXEL) -> float:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value <= largest:
        return float(value)
    raise SubjectError(f'{name} must be a number above 0 and at most {largest:g}, saw {value!r}')


def _length(value: Any, name: str, signed: bool) -> float:
    """Checks a length, m; signed lengths, such as offsets, can be negative."""
    if not signed:
        return _positive(value, f'length {name}', MAX_LENGTH)
    if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= MAX_LENGTH:
        return float(value)
    raise SubjectError(
        f'length {name} must be a number from {-MAX_LENGTH:g} to {MAX_LENGTH:g}, saw {value!r}'
    )


def _pixel(name: str, value: Any) -> tuple[float, float]:
    if (
        isinstance(value, (list, tuple))
        and len(value) == 2
        and all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in value)
        and all(abs(x) < MAX_PIXEL for x in value)
    ):
        return float(value[0]), float(value[1])
    raise SubjectError(f'keypoint {name} must be [u, v] in pixels, saw {value!r}')
