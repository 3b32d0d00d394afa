"""The space that a robot must keep out of: capsules that contain the person in all modes.

Each part of the flesh is a capsule. In every mode its radius is the sum of the radius of the flesh,
the error of the body model and the uncertainty of its position,

    r = r_flesh + MARGIN + q s,       q^2 the quantile `probability` of chi^2 with 3 dimensions

s is the standard deviation of the capsule's ends in their second most uncertain direction. Along
the most uncertain direction, usually depth, the capsule is repeated over q standard deviations.
Modes are included, heaviest first, until their weights sum to `probability`. Capsules inside other
capsules are left out. A lost person may have moved, so the radii of all capsules grow with the time
since the loss (`reach_after`).

Only the coverage that `benchmarks/keep_out.py` measures on clips is guaranteed. The guarantee
excludes people whose loss the tracker has not noticed, and long objects in people's hands.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward, point_jacobians
from hmt_ros.core import elementary, find_not_held
from hmt_ros.inference.arrays import Array, Index, Mask
from hmt_ros.inference.linear_algebra import product, symmetric_eigen
from hmt_ros.inference.mixture import GaussianMixture

# Allowance for errors of the body model, m.
MARGIN = 0.05
# Radius of a bone of a body without flesh, m.
BARE_BONE_RADIUS = 0.07
# Distance of neighbouring capsules relative to their radius.
CAPSULE_SPACING = 1.2
# Spread relative to the radius below which a capsule is widened instead of repeated.
MAX_WIDENING = 0.15
# Cosines and sines of angles around an axis.
_ANGLES = np.arange(8) * (np.pi / 4)
_RING = np.stack([elementary.cos(_ANGLES), elementary.sin(_ANGLES)])
# Speed, m/s, and reach, m, of a striking hand.
STRIKING_SPEED, ARM_REACH = 7.0, 0.7
# Speed of a runner, rarely exceeded by a person, m/s.
RUNNING_SPEED = 3.0


@dataclass(frozen=True, eq=False)
class Capsules:
    """N capsules: line segments with radii; m.

    Attributes:
        starts, ends: (N, 3) ends of the axes.
        radii: (N,).
    """

    starts: Array
    ends: Array
    radii: Array

    def __len__(self) -> int:
        return len(self.radii)

    def __getitem__(self, index: Index | Mask | list[Any]) -> Capsules:
        """Select capsules."""
        return Capsules(self.starts[index], self.ends[index], self.radii[index])

    def depths(self, points: ArrayLike) -> Array:
        """Return the depth of points (P, 3) in each capsule, (P, N) m; negative outside."""
        p = np.asarray(points, dtype=np.float64)[:, None]
        axes = self.ends - self.starts
        squares = np.maximum((axes * axes).sum(1), 1e-18)
        along = np.clip(((p - self.starts) * axes).sum(2) / squares, 0.0, 1.0)
        nearest = self.starts + along[..., None] * axes
        return np.asarray(self.radii - np.linalg.norm(p - nearest, axis=2))

    def contain(self, points: ArrayLike) -> Mask:
        """Whether each point (P, 3) lies in at least one capsule, (P,)."""
        return np.asarray((self.depths(points) >= 0.0).any(1))

    def without_contained(self) -> Capsules:
        """Drop capsules inside the union of larger capsules, tested at a few surface points."""
        order = np.argsort(-self._sizes, kind='stable')
        some = self[order]
        axes = (np.ascontiguousarray(x) for x in (some.starts, some.ends))
        kept = np.empty(len(some), dtype=np.bool_)
        find_not_held(*axes, some.radii, _RING, kept)
        return self[np.sort(order[kept])]

    def grown(self, reach: float) -> Capsules:
        """Return the capsules with radii grown by a reach, m."""
        return Capsules(self.starts, self.ends, self.radii + reach)

    @property
    def _sizes(self) -> Array:
        lengths = np.linalg.norm(self.ends - self.starts, axis=1)
        return np.asarray(np.pi * self.radii**2 * (lengths + 4.0 / 3.0 * self.radii))


def reach_after(time: float) -> float:
    """Maximum distance, m, that any part of a person moves in a time, s."""
    return min(STRIKING_SPEED * time, ARM_REACH + RUNNING_SPEED * time)


def keep_out_capsules(body: Body, mixture: GaussianMixture, probability: float = 0.99) -> Capsules:
    """Return capsules that contain the person with approximately the given probability.

    Args:
        body: body of the poses.
        mixture: mixture over the pose (d,), the posterior of an image or a forecast.
        probability: coverage of each part of the person, and total weight of the modes; below 1.

    Raises:
        ValueError: there are no modes, or the probability is not between 0 and 1.
    """
    if not len(mixture):
        raise ValueError('no modes; wanted those of a person who is tracked')
    if not 0.0 < probability < 1.0:
        raise ValueError(f'probability must be between 0 and 1, saw {probability}')
    some = mixture.sorted().normalised()
    count = int(np.searchsorted(np.cumsum(some.weights), probability)) + 1
    some = some[np.arange(min(count, len(some)))]
    wide = _radius(probability)
    segments, local, radii = _parts(body)
    frames = forward(body.skeleton, some.means)
    ends = frames.places(segments, local)
    jacobians = point_jacobians(frames, segments, ends)
    spread = product(product(jacobians, some.covariances[:, None]), jacobians.swapaxes(2, 3))
    variances, directions = symmetric_eigen(spread)
    sigmas = np.sqrt(np.maximum(variances, 0.0))
    # (K, B, 2, ...): both ends of each part.
    places = ends.reshape(len(some), -1, 2, 3)
    deep = directions[..., 2].reshape(places.shape)
    across, along = (sigmas[..., i].reshape(places.shape[:3]).max(2) for i in (1, 2))
    # Shift both ends in the same direction.
    same = np.where((deep[:, :, 0] * deep[:, :, 1]).sum(2) < 0.0, -1.0, 1.0)
    deep[:, :, 1] *= same[:, :, None]
    radius = radii + MARGIN + wide * across
    beyond = wide * np.maximum(along - across, 0.0)
    # For a small spread, widen the capsule instead of repeating it.
    little = beyond < MAX_WIDENING * radius
    radius, beyond = np.where(little, radius + beyond, radius), np.where(little, 0.0, beyond)
    steps = np.ceil(beyond / (0.5 * CAPSULE_SPACING * radius)).astype(np.intp)
    # Each part is repeated at steps + 1 places, from one end of its spread to the other.
    counts = steps.reshape(-1) + 1
    part = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(part)) - np.repeat(np.cumsum(counts) - counts, counts)
    far, last = beyond.reshape(-1)[part], steps.reshape(-1)[part]
    shifts = np.where(number < last, number * (2.0 * far / np.maximum(last, 1)) - far, far)
    at = places.reshape(-1, 2, 3)[part] + shifts[:, None, None] * deep.reshape(-1, 2, 3)[part]
    return Capsules(at[:, 0], at[:, 1], radius.reshape(-1)[part]).without_contained()


@lru_cache(maxsize=16)
def _parts(body: Body) -> tuple[Index, Array, Array]:
    """Capsules of a body in the frames of its segments.

    Returns:
        Segments (2 B,) and positions (2 B, 3) of the ends, in pairs, and radii (B,), m.
    """
    segments, ends, radii = [], [], []
    for part in body.flesh.parts:
        width = max(r * (1.0 + abs(t)) for r, t in zip(part.radii[:2], part.taper, strict=True))
        half = max(part.radii[2] - width, 0.0) * np.array([0.0, 0.0, 1.0])
        segments += [part.segment, part.segment]
        ends += [part.centre + half, part.centre - half]
        radii.append(width)
    if not radii:
        skeleton = body.skeleton
        for joints in skeleton.bones:
            segments += [int(skeleton.joint_segments[joint]) for joint in joints]
            ends += [skeleton.joint_offsets[joint] for joint in joints]
            radii.append(BARE_BONE_RADIUS)
    return np.array(segments, dtype=np.intp), np.array(ends), np.array(radii)


def _radius(probability: float) -> float:
    """Return the quantile of the length of a vector of three standard normal numbers.

    P(x) = sqrt(2 / pi) exp(-x^2 / 2) sum_k x^(2 k + 3) / (1 3 5 ... (2 k + 3))
    """
    low, high = 0.0, 9.0
    while low < (x := 0.5 * (low + high)) < high:
        term, total, k = x * x * x / 3.0, 0.0, 3
        while total + term > total:
            total, k = total + term, k + 2
            term *= x * x / k
        mass = np.sqrt(2.0 / np.pi) * elementary.exp(-0.5 * x * x) * total
        low, high = (x, high) if mass < probability else (low, x)
    return high
