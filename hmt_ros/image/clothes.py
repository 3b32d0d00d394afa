"""What a rendered person wears: colours and patterns that are fixed to the surface of the flesh.

A shirt with short sleeves, shorts, shoes, hair and a face, each with a pattern, so that matching of
intensities along the surface has something to hold on to.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_ros.body.body import Body
from hmt_ros.body.kinematics import forward

Array = NDArray[np.float64]
Index = NDArray[np.intp]

WAVES = 4
# Share of the part, from its start, that the cloth covers.
SLEEVE, SHORTS, SOCK = 0.80, 0.15, 0.90


@dataclass(frozen=True, eq=False)
class Clothes:
    """Colours of the surface of a body's P parts, BGR from 0 to 1.

    Attributes:
        body: who wears them.
        kinds: (P,) 'head', 'shirt', 'sleeve', 'skin', 'shorts', 'shin' or 'shoe'.
        skin, hair, shirt, print_, shorts, shoe: colours.
        waves: (WAVES, 3) of the pattern, rad/m; phases: (P, WAVES).
        stripes: of the shirt, per metre.
    """

    body: Body
    kinds: tuple[str, ...]
    skin: Array
    hair: Array
    shirt: Array
    print_: Array
    shorts: Array
    shoe: Array
    waves: Array
    phases: Array
    stripes: float

    @classmethod
    def of_seed(cls, body: Body, seed: int) -> Clothes:
        """Random clothes for a body."""
        rng = np.random.default_rng([seed, 11])

        def colour(saturation: tuple[float, float], value: tuple[float, float]) -> Array:
            hsv = (rng.random(), rng.uniform(*saturation), rng.uniform(*value))
            return np.array(colorsys.hsv_to_rgb(*hsv)[::-1])

        tone = rng.uniform(0.0, 1.0)
        skin = (1 - tone) * np.array([0.66, 0.76, 0.95]) + tone * np.array([0.28, 0.40, 0.58])
        hair = np.array([0.10, 0.14, 0.22]) * rng.uniform(0.5, 2.2)
        count = len(body.shapes)
        return cls(
            body=body,
            kinds=tuple(_kind(body.skeleton.segment_names[s.segment]) for s in body.shapes),
            skin=skin,
            hair=hair,
            shirt=colour((0.55, 0.9), (0.65, 0.95)),
            print_=colour((0.0, 0.5), (0.8, 1.0)),
            shorts=colour((0.3, 0.8), (0.2, 0.5)),
            shoe=colour((0.0, 0.5), (0.15, 0.9)),
            waves=rng.normal(size=(WAVES, 3)) * (2 * np.pi / np.array([[0.30], [0.16], [0.10], [0.07]])),
            phases=rng.uniform(0, 2 * np.pi, (count, WAVES)),
            stripes=float(rng.uniform(9.0, 14.0)),
        )

    def places(self, segments: Index, points: Array) -> Array:
        """Places (V, 4) on the surface of points (V, 3) given in the frames of segments (V,), m.

        Of the person at rest: right, forward and up of the start of the segment, m; then the share of
        the segment's length, from its start.
        """
        rest = forward(self.body.skeleton, np.zeros((1, self.body.dimension)))
        pelvis = rest.columns[0, :, :, 0]
        at = rest.directions(segments, points)[:, :, 0] @ pelvis.T
        ends = np.ones(len(self.body.skeleton.segment_names))
        for shape in self.body.shapes:
            if shape.length is not None:
                ends[shape.segment] = max(float(self.body.skeleton.lengths[shape.length]), 1e-3)
        return np.concatenate([at, -points[:, 2:] / ends[segments, None]], axis=1)

    def colours(self, parts: Index, places: Array) -> Array:
        """Colours (M, 3) of places (M, 4) on parts (M,)."""
        x, y, z, share = places.T
        angle = places[:, :3] @ self.waves.T + self.phases[parts]
        pattern = np.sin(angle).sum(1) / WAVES
        result = np.empty((len(parts), 3))
        of_kind = np.array([KINDS.index(kind) for kind in self.kinds])[parts]
        for kind in np.unique(of_kind):
            here = np.flatnonzero(of_kind == kind)
            name = KINDS[kind]
            result[here] = self._of_kind(name, x[here], y[here], z[here], share[here], pattern[here])
        return result

    def _of_kind(self, kind: str, x: Array, y: Array, z: Array, share: Array, p: Array) -> Array:
        def choose(where: NDArray[np.bool_], a: Array, b: Array) -> Array:
            return np.where(where[:, None], a, b)

        skin = self.skin * (1.0 + 0.10 * p[:, None])
        scale = self.body.scale
        if kind == 'head':
            x, y, z = x / scale, y / scale, z / scale - 0.185
            hair = self.hair * (1.0 + 0.6 * p[:, None])
            eyes = (np.abs(np.abs(x) - 0.030) < 0.013) & (np.abs(z - 0.010) < 0.009) & (y > 0)
            mouth = (np.abs(x) < 0.028) & (np.abs(z + 0.055) < 0.008) & (y > 0)
            face = choose(eyes, np.array([0.15, 0.12, 0.12]), skin)
            face = choose(mouth, self.skin * np.array([0.6, 0.55, 0.8]), face)
            crown = (z - 0.9 * y > 0.015) & (z > -0.085)
            return choose(crown, hair, face)
        if kind in ('shirt', 'sleeve'):
            cloth = self.shirt * (1.0 + 0.35 * p[:, None])
            cloth = choose(np.sin(2 * np.pi * self.stripes * z / scale) > 0.35, 0.55 * cloth, cloth)
            if kind == 'sleeve':
                return choose(share < SLEEVE, cloth, skin)
            up = z / scale
            chest = (np.abs(x / scale) < 0.075) & (np.abs(up - 0.30) < 0.09)
            bars = (np.abs(x / scale) < 0.04) | (np.abs(up - 0.30) < 0.03)
            logo = chest & np.where(y > 0, bars, ~bars)
            return choose(logo, self.print_ * (1.0 + 0.1 * p[:, None]), cloth)
        if kind in ('shorts', 'shin'):
            cloth = self.shorts * (1.0 + 0.7 * np.sign(p[:, None]) * np.abs(p[:, None]) ** 0.7)
            if kind == 'shorts':
                return cloth
            bare = choose(share > SOCK, np.full(3, 0.85) * (1 + 0.1 * p[:, None]), skin)
            return choose(share < SHORTS, cloth, bare)
        if kind == 'shoe':
            shoe = self.shoe * (1.0 + 0.3 * p[:, None])
            return choose(np.sin(x / scale * 90.0) > 0.6, 0.5 * shoe, shoe)
        return skin


KINDS = ('head', 'shirt', 'sleeve', 'shorts', 'shin', 'shoe', 'skin')
_KIND_OF_WORD = {
    'head': 'head', 'neck': 'head', 'trunk': 'shirt', 'pelvis': 'shorts', 'upper_arm': 'sleeve',
    'thigh': 'shorts', 'shin': 'shin', 'foot': 'shoe',
}  # fmt: skip


def _kind(segment: str) -> str:
    return next((kind for word, kind in _KIND_OF_WORD.items() if word in segment), 'skin')
