"""Keypoint schemes: the landmark names of detectors, and the places of landmarks on a body.

A detector's "hip" is a point on the skin that annotators agreed on, not the centre of the joint.
`keypoint_schemes.yaml` contains all names and offsets.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from hmt_ros.core import elementary
from hmt_ros.inference.arrays import Array
from msg_tools.files.plain_yaml import read_plain_yaml

SIDES = ('right', 'left')
MIRROR = np.array([-1.0, 1.0, 1.0])
AUTO, JOINTS = 'auto', 'joints'
MAX_FILE_BYTES = 1_000_000  # bytes


@dataclass(frozen=True, eq=False)
class Landmark:
    """A point on a person's body that detectors find.

    Attributes:
        name: canonical name.
        joint: joint at or near the landmark, named as in the package's bodies; '' if missing.
        offset: (3,) from the joint to the landmark in the frame of the joint's segment, m, for a
            person of 1.7 m.
        sigma: standard deviation of each component of the offset over people, m.
    """

    name: str
    joint: str
    offset: Array
    sigma: float


@dataclass(frozen=True, eq=False)
class Scheme:
    """The landmarks of a family of detectors.

    Attributes:
        name: name of the scheme.
        names: names of the landmarks, in the detectors' order.
        landmarks: the landmarks, in the same order.
    """

    name: str
    names: tuple[str, ...]
    landmarks: tuple[Landmark, ...]

    def landmark(self, name: str) -> Landmark | None:
        """The landmark with this name; None if the scheme does not have the name."""
        return self.landmarks[self.names.index(name)] if name in self.names else None


@cache
def _table() -> Any:
    file = resources.files('hmt_ros.image') / 'keypoint_schemes.yaml'
    with resources.as_file(file) as path:
        return read_plain_yaml(path, MAX_FILE_BYTES)


@cache
def landmarks() -> Mapping[str, Landmark]:
    """All landmarks by their canonical names."""
    result: dict[str, Landmark] = {}
    for template, entry in _table()['landmarks'].items():
        for side in SIDES if '{side}' in template else SIDES[:1]:
            name = template.format(side=side)
            offset = np.array(entry.get('offset', (0.0, 0.0, 0.0)), dtype=np.float64)
            joint = entry.get('joint', '').format(side=side)
            sigma = float(entry.get('sigma', 0.0))
            result[name] = Landmark(
                name, joint, offset * MIRROR if side == 'left' else offset, sigma
            )
    return result


@cache
def schemes() -> Mapping[str, Scheme]:
    """All schemes by name."""
    result = {}
    for scheme, entries in _table()['schemes'].items():
        pairs = [next(iter(x.items())) if isinstance(x, dict) else (x, x) for x in entries]
        names = tuple(name for name, _ in pairs)
        result[scheme] = Scheme(scheme, names, tuple(landmarks()[x] for _, x in pairs))
    return result


@cache
def unnamed_orders() -> Mapping[int, tuple[str, ...]]:
    """For each number of keypoints without names, the possible schemes, the usual scheme first.

    A scheme with fewer names describes the first keypoints only.
    """
    return {int(count): tuple(names) for count, names in _table()['unnamed'].items()}


@cache
def bone_lengths() -> Mapping[tuple[str, str], tuple[float, float]]:
    """Distance, m, of landmark pairs of a 1.7 m person, and standard deviation of its logarithm."""
    return {
        (one.format(side=side), other.format(side=side)): (float(length), float(sigma))
        for one, others in _table()['bones'].items()
        for other, (length, sigma) in others.items()
        for side in (SIDES if '{side}' in one else SIDES[:1])
    }


def scheme_of(names: Sequence[str], scheme: str = AUTO) -> Scheme | None:
    """The scheme of keypoints with these names; None if the names are names of joints.

    Args:
        scheme: name of a scheme, 'joints', or 'auto' for the result of `recognised`.

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
    """The smallest scheme with all names, if one exists and the names include a nose or a spine.

    Names of limbs and trunk are the same in all schemes; without further names they are taken as
    joints.
    """
    fitting = [x for x in schemes().values() if set(names) <= set(x.names)]
    found = min(fitting, key=lambda x: len(x.names), default=None)
    return found if {'nose', 'spine1'} & {*names} else None


def landmarks_of(
    names: Sequence[str], joints: Sequence[str], scheme: str = AUTO
) -> list[Landmark | None]:
    """The landmark of each named keypoint; None for a joint of the body or an unknown name.

    Args:
        joints: names of the body's joints; if no scheme is found, a keypoint with such a name is a
            joint.

    Raises:
        ValueError: there is no such scheme.
    """
    found = scheme_of(names, scheme)
    if found is not None:
        return [found.landmark(name) for name in names]
    own = names if scheme == JOINTS else joints
    return [None if name in own else landmark_called(name) for name in names]


def landmark_called(name: str) -> Landmark | None:
    """The landmark with this name in the first scheme that has it; None if no scheme has it."""
    found = (scheme.landmark(name) for scheme in schemes().values())
    return next((landmark for landmark in found if landmark is not None), None)


def noise_of(confidences: Array) -> Array:
    """Standard deviations (n,) of keypoints from their confidences (n,), m at the person."""
    model = _table()['noise']
    result: Array = np.interp(confidences, model['confidence'], model['sigma'])
    return result


@cache
def position_deviations(scheme: str | None) -> Mapping[str, float]:
    """Standard deviations of a detector's joint depths, m, by kind of joint.

    Args:
        scheme: name of the detector's scheme; None or a scheme without measured values gives usual
            values.
    """
    content = _table()['positions']
    return {**content['usual'], **content.get(scheme, {})}


@cache
def exchange_rates() -> Array:
    """Transition rates (E, E), 1/s, between a detector's exchanges of sides."""
    rates = np.array(_table()['exchanges']['rates'], dtype=np.float64)
    return rates - np.diag(rates.sum(1))


@cache
def usual_exchanges() -> Array:
    """Log probability (1, E) of each exchange, without information from earlier images."""
    at_first = np.array(_table()['exchanges']['at_first'], dtype=np.float64)
    return np.asarray(elementary.log(at_first)[None])
