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

from hmt_ros.body.skeleton import other_side
from hmt_ros.inference.arrays import Array
from msg_tools.files.plain_yaml import read_plain_yaml

SIDES = ('right', 'left')
MIRROR = np.array([-1.0, 1.0, 1.0])
AUTO, JOINTS = 'auto', 'joints'
LARGEST_FILE = 1_000_000  # bytes


@dataclass(frozen=True, eq=False)
class Landmark:
    """A point of a person that detectors find.

    Attributes:
        name: canonical.
        joint: of our bodies that it is at, or near; '': none.
        offset: (3,) from the joint in the frame of the joint's segment, m, of a person of 1.7 m.
        sigma: standard deviation of each component of the offset over people, m.
    """

    name: str
    joint: str
    offset: Array
    sigma: float


@dataclass(frozen=True)
class SlopeModel:
    """A bone of a lifted skeleton whose slope against the line of sight is a measurement.

    Attributes:
        segment: of the body that it is fixed to.
        ends: names of the joints from which and to which it goes; `mid_x` is between the left and
            the right x.
        sigma: standard deviation of the cosine of its angle with the line of sight.
        sign: of the slope where sides are exchanged, against that of the bone of the other side.
    """

    segment: str
    ends: tuple[str, str]
    sigma: float
    sign: float

    def mirrored(self) -> SlopeModel:
        """The bone of the other side."""
        first, last = map(other_side, self.ends)
        return SlopeModel(other_side(self.segment), (first, last), self.sigma, self.sign)


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
def _table() -> Any:
    file = resources.files('hmt_ros.image') / 'keypoint_schemes.yaml'
    with resources.as_file(file) as path:
        return read_plain_yaml(path, LARGEST_FILE)


@cache
def schemes() -> Mapping[str, Scheme]:
    """All schemes by name."""
    content = _table()
    landmarks: dict[str, Landmark] = {}
    for template, entry in content['landmarks'].items():
        for side in SIDES if '{side}' in template else SIDES[:1]:
            name = template.format(side=side)
            offset = np.array(entry.get('offset', (0.0, 0.0, 0.0)), dtype=np.float64)
            joint = entry.get('joint', '').format(side=side)
            sigma = float(entry.get('sigma', 0.0))
            landmarks[name] = Landmark(
                name, joint, offset * MIRROR if side == 'left' else offset, sigma
            )
    result = {}
    for scheme, entries in content['schemes'].items():
        pairs = [next(iter(x.items())) if isinstance(x, dict) else (x, x) for x in entries]
        names = tuple(name for name, _ in pairs)
        result[scheme] = Scheme(scheme, names, tuple(landmarks[x] for _, x in pairs))
    return result


def scheme_of(names: Sequence[str], scheme: str = AUTO) -> Scheme | None:
    """The scheme of keypoints; None: their names are those of joints.

    Args:
        names: of the keypoints.
        scheme: name of a scheme, 'joints', or 'auto': see `recognised`.

    Raises:
        ValueError: there is no such scheme.
    """
    if scheme == AUTO:
        return recognised(names)
    if scheme == JOINTS:
        return None
    if scheme not in schemes():
        raise ValueError(
            f'there is no keypoint scheme {scheme!r}, wanted one of {[AUTO, JOINTS, *schemes()]}'
        )
    return schemes()[scheme]


def recognised(names: Sequence[str]) -> Scheme | None:
    """The scheme that has all of the names, the smallest, if it has points of a face among them.

    Limbs and trunk have the same names everywhere: alone they are taken for joints.
    """
    fitting = [x for x in schemes().values() if set(names) <= set(x.names)]
    found = min(fitting, key=lambda x: len(x.names), default=None)
    return found if 'nose' in names else None


def landmarks_of(
    names: Sequence[str], joints: Sequence[str], scheme: str = AUTO
) -> list[Landmark | None]:
    """What the names of keypoints mean; None: a joint of the body, or nothing that is known.

    Args:
        names: of the keypoints.
        joints: of the body; outside schemes a name of one of them means this joint.
        scheme: see `scheme_of`.

    Raises:
        ValueError: there is no such scheme.
    """
    found = scheme_of(names, scheme)
    if found is not None:
        return [found.landmark(name) for name in names]
    own = names if scheme == JOINTS else joints
    return [None if name in own else landmark_called(name) for name in names]


def landmark_called(name: str) -> Landmark | None:
    """The landmark that the first scheme with a name calls by it; None: no scheme has the name."""
    found = (scheme.landmark(name) for scheme in schemes().values())
    return next((landmark for landmark in found if landmark is not None), None)


@cache
def slope_models() -> tuple[SlopeModel, ...]:
    """The bones of lifted skeletons."""
    result = []
    for segment, first, last, sigma, sign in _table()['slopes']:
        for side in SIDES if '{side}' in segment else SIDES[:1]:
            ends = (first.format(side=side), last.format(side=side))
            segment_name = segment.format(side=side)
            result.append(SlopeModel(segment_name, ends, float(sigma), float(sign)))
    return tuple(result)


def noise_of(confidences: Array) -> Array:
    """Standard deviations (n,) of keypoints of some confidences (n,), m at the person."""
    model = _table()['noise']
    result: Array = np.interp(confidences, model['confidence'], model['sigma'])
    return result


@cache
def exchange_rates() -> Array:
    """(E, E) rates per second at which a detector goes from one exchange of sides to another."""
    rates = np.array(_table()['exchanges']['rates'], dtype=np.float64)
    return rates - np.diag(rates.sum(1))


@cache
def usual_exchanges() -> Array:
    """(1, E) log probability of each exchange, where nothing is known of the images before."""
    return np.log(np.array(_table()['exchanges']['at_first'], dtype=np.float64))[None]
