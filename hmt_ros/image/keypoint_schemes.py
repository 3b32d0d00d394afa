"""Keypoint schemes: what detectors call the landmarks of a person, and where these lie on a body.

A detector's "hip" is a point on the skin that annotators agreed on, not the centre of the joint.
`keypoint_schemes.yaml` is the one table of names and offsets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from hmt_ros.inference.arrays import Array
from msg_tools.files.plain_yaml import read_plain_yaml

SIDES = ('right', 'left')
# Names that say nothing of the scheme: those of joints, which all detectors use.
LARGEST_FILE = 1_000_000  # bytes
NOT_AT_A_JOINT = ''


@dataclass(frozen=True, eq=False)
class Landmark:
    """A point of a person that detectors find.

    Attributes:
        name: canonical.
        joint: of our bodies that it is at, or near; '': none.
        offset: (3,) from the joint in the frame of the joint's segment, m, of a person of 1.7 m.
    """

    name: str
    joint: str
    offset: Array


@dataclass(frozen=True, eq=False)
class Scheme:
    """The landmarks of a family of detectors.

    Attributes:
        name: of the scheme.
        names: of the landmarks, in the detectors' order.
        landmarks: what the names mean.
    """

    name: str
    names: tuple[str, ...]
    landmarks: tuple[Landmark, ...]

    def landmark(self, name: str) -> Landmark | None:
        """What a name means; None: the scheme does not have it."""
        return self.landmarks[self.names.index(name)] if name in self.names else None


@cache
def schemes() -> Mapping[str, Scheme]:
    """All schemes by name."""
    file = resources.files('hmt_ros.image') / 'keypoint_schemes.yaml'
    with resources.as_file(file) as path:
        content: Any = read_plain_yaml(path, LARGEST_FILE)
    landmarks: dict[str, Landmark] = {}
    for template, entry in content['landmarks'].items():
        for side in SIDES if '{side}' in template else SIDES[:1]:
            name = template.format(side=side)
            offset = np.array(entry.get('offset', (0.0, 0.0, 0.0)), dtype=np.float64)
            if side == 'left':
                offset = offset * (-1.0, 1.0, 1.0)
            joint = entry.get('joint', NOT_AT_A_JOINT).format(side=side)
            landmarks[name] = Landmark(name, joint, offset)
    result = {}
    for scheme, entries in content['schemes'].items():
        pairs = [next(iter(x.items())) if isinstance(x, dict) else (x, x) for x in entries]
        names = tuple(name for name, _ in pairs)
        result[scheme] = Scheme(scheme, names, tuple(landmarks[x] for _, x in pairs))
    return result


def recognised(names: Sequence[str]) -> Scheme | None:
    """The scheme that has all of the names, the smallest; None: no scheme has all."""
    fitting = [x for x in schemes().values() if set(names) <= set(x.names)]
    return min(fitting, key=lambda x: len(x.names), default=None)
